"""`gnd report`: a finished run as one page that one can send to somebody else."""
