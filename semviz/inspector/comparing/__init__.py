"""A run beside another one."""
