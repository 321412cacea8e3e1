"""A conformance kit for components: does an FMU or a Python class do what whoever runs it counts on?

`cosim fmu test` prints what `check` finds; call it from your own tests:

    from cosim.conformance import check

    def test_my_component():
        check("motors:Motor").require()
"""

from cosim.conformance.report import ConformanceError, Finding, Report, Verdict
from cosim.conformance.supervising import check

__all__ = ["ConformanceError", "Finding", "Report", "Verdict", "check"]
