"""Other files for the same Gaussians: compressed PLY, SPZ, SOG, binary glTF; one module each."""
