"""Plants: rational transfer matrices with their noise, their norms, names, files and realisations."""
