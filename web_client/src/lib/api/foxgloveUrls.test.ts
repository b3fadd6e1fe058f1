import { expect, it } from 'vitest'
import { opensFromWeb } from './foxgloveUrls'

it.each([
  ['wss://relay.example.org/robots/rover?token=t', true],
  ['wss://192.0.2.7:8443/robots/rover', true],
  ['ws://localhost:8080/robots/rover', true],
  ['ws://127.0.0.1/robots/rover', true],
  ['ws://[::1]:8080/robots/rover', true],
  ['ws://relay.example.org/robots/rover', false],
  ['ws://192.0.2.7:8080/robots/rover', false],
  ['ws://localhost.example.org/robots/rover', false],
  ['ws://127.0.0.1.example.org/robots/rover', false],
  ['ws://relay.example.org/robots/rover?token=wss://', false],
])('an https page opens %s: %s', (url, opens) => {
  expect(opensFromWeb(url)).toBe(opens)
})
