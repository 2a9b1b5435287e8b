"""`ussim bench`: time per stage and per frame on every OpenCL device, against what the machine could do at most."""
