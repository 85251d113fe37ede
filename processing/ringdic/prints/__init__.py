"""Sheets to print at true scale: the dots of the calibration cylinder, boards, speckle patterns."""
