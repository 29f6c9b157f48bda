"""Figures and tables of scenes, blocks, pairs and sites."""
