"""What a diagnosis gives: the verdict with its figures, the model as an object, files and plots."""
