import { expect, it } from 'vitest'
import { mediaOf } from './roles'

it.each([
  ['gamepad.rdf', '', 'application/rdf+xml'],
  ['a.TTL', '', 'text/turtle'],
  ['a.jsonld', '', 'application/ld+json'],
  ['a.xml', '', 'application/rdf+xml'],
  ['a', '\ufeff<?xml version="1.0"?>', 'application/rdf+xml'],
  ['a.json', ' [{}]', 'application/ld+json'],
  ['a.txt', '@prefix', 'text/turtle'],
])('%s with %j is %s', (name, text, media) => {
  expect(mediaOf(name, text)).toBe(media)
})
