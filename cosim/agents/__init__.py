"""Agents: their components, what moves between them, and the loop that takes them from one tick to the next. Pure."""
