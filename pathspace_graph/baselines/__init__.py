"""What the spline estimators are compared with: landmark graphs, and the paper's filters."""
