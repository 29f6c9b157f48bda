"""Mathematics without cameras or images."""
