"""Shared by both web tools: the gateway, the protocol, the 3D scene and the page style."""
