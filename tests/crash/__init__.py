"""Crash consistency: acknowledged records survive any system call that fails or is the last one."""
