"""`cosim run` and `cosim check`: a plan is played in this process, watched, paced, stopped, and its end told."""
