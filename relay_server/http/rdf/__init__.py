"""State as RDF: encode, decode, serialize, vocabulary."""
