"""`python -m cosim` is `cosim`."""

import sys

from cosim.cli import main

sys.exit(main())
