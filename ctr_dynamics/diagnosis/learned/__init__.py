"""What no effect of the catalogue explains, learned from the bags as a force on the tip."""
