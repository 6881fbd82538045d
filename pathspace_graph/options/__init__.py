"""The commands as frozen dataclasses of their options; no module here waits for GTSAM or scipy."""
