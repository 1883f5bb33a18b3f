"""The bench as physics: screens, sources, the forward model, the detector, and devices made of them."""
