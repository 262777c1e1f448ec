"""Everything that can give frames, behind one protocol, and the clock that tells when they were."""
