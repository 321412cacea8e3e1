"""Co-simulation of networked multi-agent systems."""
