import { expect, it } from 'vitest'
import { afterLogin, cockpitPath, loginCode, parse, REALM_PARTS, realmPath } from './route'

it('reads the pages out of the address', () => {
  expect(parse('/')).toEqual({ page: 'fleet' })
  expect(parse('/fleet')).toEqual({ page: 'fleet' })
  expect(parse('/login')).toEqual({ page: 'login' })
  expect(parse('/alerts')).toEqual({ page: 'alerts' })
  expect(parse('/pipes')).toEqual({ page: 'pipes' })
  expect(parse('/diagram')).toEqual({ page: 'diagram' })
  expect(parse('/functions')).toEqual({ page: 'functions' })
  expect(parse('/files')).toEqual({ page: 'files', robot: '' })
  expect(parse('/files/a%20b')).toEqual({ page: 'files', robot: 'a b' })
  expect(parse('/cockpit/rover-1')).toEqual({ page: 'cockpit', robot: 'rover-1' })
  expect(parse('/cockpit/%E0%A4%A')).toEqual({ page: 'unknown' })
  expect(parse('/elsewhere')).toEqual({ page: 'unknown' })
})

it('knows the parts of a realm', () => {
  expect(parse('/realm')).toEqual({ page: 'realm', part: 'robots' })
  for (const part of REALM_PARTS) expect(parse(realmPath(part))).toEqual({ page: 'realm', part })
  expect(parse('/realm/tokens')).toEqual({ page: 'unknown' })
  expect(parse('/realm/rights/rover')).toEqual({ page: 'unknown' })
  expect(realmPath('rights', { who: '@crew', robot: '' })).toBe('/realm/rights?who=%40crew')
})

it('writes robot names so that they can be read back', () => {
  for (const name of ['rover-1', 'a b', 'ä/ö', '%41']) {
    expect(parse(cockpitPath(name))).toEqual({ page: 'cockpit', robot: name })
  }
})

it('goes to a page of the portal after the login, nowhere else', () => {
  expect(afterLogin('?next=%2Fcockpit%2Frover-1')).toBe('/cockpit/rover-1')
  expect(afterLogin('?next=%2Falerts')).toBe('/alerts')
  expect(afterLogin('?next=%2Fpipes')).toBe('/pipes')
  expect(afterLogin('?next=%2Fdiagram')).toBe('/diagram')
  expect(afterLogin('?next=%2Ffunctions')).toBe('/functions')
  expect(afterLogin('?next=%2Ffiles%2Frover')).toBe('/files/rover')
  expect(afterLogin('?next=%2Frealm%2Frights')).toBe('/realm/rights')
  for (const next of ['https://evil.example/', '//evil.example/x', 'javascript:alert(1)', '/api/v1/session', '']) {
    expect(afterLogin(`?next=${encodeURIComponent(next)}`)).toBe('/fleet')
  }
})

it('finds the code of a login link', () => {
  expect(loginCode('#code=ABC-123')).toBe('ABC-123')
  expect(loginCode('#code=')).toBeNull()
  expect(loginCode('')).toBeNull()
})
