"""Pure numerics: from pixels to wavefronts. No device, no file, no Qt."""
