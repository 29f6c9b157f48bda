"""Bundle adjustment of panoramic cameras: control, tie points, priors, diagnostics."""
