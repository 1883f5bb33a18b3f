"""Evaluation of the instrument: self-test, studies, benchmark, and the tables of the paper."""
