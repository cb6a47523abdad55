"""semviz annotate: label poles and signs in stereo images."""
