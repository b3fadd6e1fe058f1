"""The HTTP framework: site, endpoints, limits, errors, conditional requests, media types, OpenAPI, RDF."""
