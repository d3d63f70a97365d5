"""Replay, one gradient step, and its compilation."""
