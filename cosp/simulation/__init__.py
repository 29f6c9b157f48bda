"""A whole site with known truth: terrain, orbit, exposed film with its defects, and reference data."""
