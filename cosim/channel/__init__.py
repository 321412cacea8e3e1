"""`cosim channel`: a profile played alone, a measured log turned into a profile, and the docs of every parameter."""
