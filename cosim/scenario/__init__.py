"""What the user wrote: YAML text, overrides and templates, read into a validated scenario."""
