"""The Hungarian landmark estimators that the curves are compared with: online, batch and filter."""
