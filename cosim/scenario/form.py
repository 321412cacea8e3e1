"""What all parts of a scenario have in common."""

from pydantic import ConfigDict

FORM = ConfigDict(extra="forbid", strict=True, frozen=True, validate_by_name=True, validate_by_alias=True)
"""No unknown keys, no silent conversions."""
