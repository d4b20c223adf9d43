"""What is measured, and how: robots through scripted episodes, speed, success rates."""
