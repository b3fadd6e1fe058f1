"""The HTTP framework: limits, errors, conditional requests, forms, OpenAPI, RDF, the site."""
