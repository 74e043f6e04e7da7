"""What all folders share: compiled code and its cache, threads, calls of CasADi functions with arrays."""
