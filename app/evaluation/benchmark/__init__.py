"""How fast this instrument is beside its peers, on the same frames, in one run; `svwfs benchmark`."""
