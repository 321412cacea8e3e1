"""FMUs that misbehave."""

from tests.components.probe import probe_library, probes

__all__ = ["probe_library", "probes"]
