"""Speed beside the peers on the same frames, for `svwfs benchmark`."""
