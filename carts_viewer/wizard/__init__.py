"""New recording: from raw files to a sequence file with a hand-eye calibration."""
