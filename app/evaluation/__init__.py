"""How good the instrument is: self-test, studies, benchmark, and the tables of the paper."""
