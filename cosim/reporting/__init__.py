"""From a run folder to figures and a page, on the data that `cosim.results` reads."""
