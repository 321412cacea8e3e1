"""The emulated network: what travels, and what becomes of it. It knows no FMU."""
