"""The running service: tasks, actions, processes."""
