"""What an agent consists of: FMUs and Python classes, behind one interface."""
