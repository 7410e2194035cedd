"""Tracks: their geometry (`track.Track`), lanes, sectors, outline and official boards."""
