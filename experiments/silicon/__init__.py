"""Measuring a real NVIDIA GPU, and the model beside what was measured."""
