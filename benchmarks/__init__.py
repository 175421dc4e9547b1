"""Measurements whose results are committed: each module says what it measures, results/ what it found."""
