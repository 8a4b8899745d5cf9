"""The command `bdgs`."""
