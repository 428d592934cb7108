"""Files in, answers out, no service: fits of measured matrices, reconstructors, exports."""
