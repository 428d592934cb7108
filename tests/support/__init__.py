"""What tests share. No test module imports another; ``test_house`` holds that."""
