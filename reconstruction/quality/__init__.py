"""Quality of frames, references and wavefronts, and the information in a frame."""
