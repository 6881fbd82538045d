"""What the boundary estimators are compared with: landmarks, the paper's filters, and one centre line."""
