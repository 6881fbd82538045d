"""The one way in which estimators are run and measured over many logs, in parallel."""
