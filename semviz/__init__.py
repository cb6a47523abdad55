"""The application: command line, workspace, recordings and the two web tools."""
