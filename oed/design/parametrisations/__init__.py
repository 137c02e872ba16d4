"""Other parametrisations of the spectrum than free lines: autocorrelations, shapes, masks, amplitudes."""
