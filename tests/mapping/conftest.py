"""FMUs of the probe."""

from tests.components.probe import probe_library

__all__ = ["probe_library"]
