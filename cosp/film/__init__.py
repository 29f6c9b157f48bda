"""The film: its parts joined, its format found, its bending taken out."""
