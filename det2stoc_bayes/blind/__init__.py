"""Studies with concealed physics: made here, diagnosed elsewhere, scored here; no code is shared."""
