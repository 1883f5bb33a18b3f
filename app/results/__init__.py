"""Results as files and figures: NetCDF, plots, export, replay, and the PDF report."""
