"""Measuring: tracking errors, success rates, speed; reports, pictures and recordings of what was measured."""

from robots import startup as startup  # before MuJoCo is imported
