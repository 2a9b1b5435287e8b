"""`ussim bench`: time per stage and per frame on every OpenCL device, compared with lower bounds."""
