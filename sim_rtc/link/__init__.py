"""The link to the service: what is sent, answered, taken in, recorded and replayed."""
