"""From records to the H-infinity norm without a parametric model."""
