"""Images of a drive: files, folders and recordings, colours, and rectification."""
