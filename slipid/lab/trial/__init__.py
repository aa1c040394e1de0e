"""Closed-loop trials that compare controllers, among them published control laws."""
