"""Generic machinery of runs: files, configurations, logs, progress, ranks, errors of commands."""
