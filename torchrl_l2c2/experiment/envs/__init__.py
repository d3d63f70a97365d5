"""Environments of tasks."""
