"""Measuring: tracking errors, success rates, speed; reports, pictures and recordings of what was measured."""
