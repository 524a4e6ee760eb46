"""What records say: values without any drawing, the lower a module stands on others the plainer."""
