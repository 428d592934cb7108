"""What was measured on the simulated telescope; each study is a script with a command line."""
