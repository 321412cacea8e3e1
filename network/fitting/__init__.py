"""Channel parameters from a measured log, by maximum likelihood."""
