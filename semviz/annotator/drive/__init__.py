"""The views "Your drive" and "Poses": checks of the import and of the poses."""
