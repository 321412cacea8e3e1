"""The probe, for packages of FMUs with variables of every kind."""

from tests.components.probe import probe_library, probes

__all__ = ["probe_library", "probes"]
