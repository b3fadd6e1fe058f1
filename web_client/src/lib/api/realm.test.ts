import { afterEach, beforeEach, describe, expect, it, vi } from 'vitest'
import { addUser, AT_ONCE, changeUser, fetchAllPages, grant, held, leave, Superseded, rights, tokens, type Asked } from './realm'

const HERE = '/api/v1/realm'
let asked: { path: string; init: RequestInit }[]
let answers: unknown[]

beforeEach(() => {
  asked = []
  answers = []
  vi.stubGlobal('fetch', async (path: string, init: RequestInit) => {
    asked.push({ path, init })
    const answer = answers.shift() ?? {}
    return answer instanceof Response ? answer : new Response(JSON.stringify(answer), { headers: { ETag: '"now"' } })
  })
})

afterEach(() => {
  vi.unstubAllGlobals()
})

const MISSING = () => new Response('{}', { status: 404 })
const RIGHT = { robot: 'rover', holder: '@night shift', level: 'viewer', allow: [], deny: ['call:/x'] } as const

describe('what is asked of a realm', () => {
  it('has names in its address, the mark of a group as it is', async () => {
    answers = [MISSING()]
    await grant({ ...RIGHT, allow: [], deny: ['call:/x'] }, null)
    await leave('crew', 'ä?b')
    expect(asked.map(({ path, init }) => [init.method, path])).toEqual([
      ['GET', `${HERE}/rights/rover/@night%20shift`],
      ['PUT', `${HERE}/rights/rover/@night%20shift`],
      ['DELETE', `${HERE}/groups/crew/members/%C3%A4%3Fb`],
    ])
    expect(JSON.parse(String(asked[1]?.init.body))).toEqual({ level: 'viewer', allow: [], deny: ['call:/x'] })
  })

  it('says that it comes from the portal, which the cookie of a session takes', async () => {
    await leave('crew', 'ann')
    expect(new Headers(asked[0]?.init.headers).get('x-requested-with')).toBe('switchboard')
    expect(asked[0]?.init.credentials).toBe('same-origin')
  })

  it('leaves out a password that there is not', async () => {
    await addUser('logger', '', false)
    await addUser('ann', 'correct horse', true)
    expect(asked.map(({ init }) => JSON.parse(String(init.body)))).toEqual([
      { name: 'logger', admin: false },
      { name: 'ann', admin: true, password: 'correct horse' },
    ])
  })

  it('leaves out filters that are empty', async () => {
    answers = [{ tokens: [{ id: 'a' }], next: 'a' }]
    expect(await tokens('ann', { limit: 5, after: '', name: 'x*/&' })).toEqual({ items: [{ id: 'a' }], next: 'a' })
    await rights({ user: '', name: '' })
    expect(asked.map(({ path }) => path)).toEqual([`${HERE}/users/ann/tokens?limit=5&name=x*%2F%26`, `${HERE}/rights`])
  })
})

it('gathers a list of parts up to a length', async () => {
  const ask = vi.fn(async ({ limit = 0, after = '' }: Asked) => {
    const from = Number(after)
    const items = Array.from({ length: Math.min(limit, 2500 - from) }, (_, i) => from + i)
    const end = from + items.length
    return { items, next: end < 2500 ? String(end) : '' }
  })
  expect((await fetchAllPages(ask, 1200)).items).toHaveLength(1200)
  expect(ask.mock.calls.map(([{ limit, after }]) => [limit, after])).toEqual([
    [AT_ONCE, ''],
    [200, '1000'],
  ])
  const all = await fetchAllPages(ask, 5000)
  expect([all.items.length, all.next]).toEqual([2500, ''])
})

it('finds the right that somebody has already', async () => {
  answers = [{ ...RIGHT, holder: 'ann' }, MISSING()]
  expect((await held('rover', 'Ann'))?.holder).toBe('ann')
  expect(await held('rover', '@ann')).toBeNull()
})

describe('what several administrators change', () => {
  const ann = { user: 'ann', admin: false, disabled: false, password: true, guest: false, groups: ['crew'] }
  const shown = { ...RIGHT, allow: [], deny: ['call:/x'] }
  const sent = (name: string) => new Headers(asked.at(-1)?.init.headers).get(name)

  it('is changed only as it was shown', async () => {
    answers = [ann, { ...ann, admin: true }]
    expect((await changeUser(ann, { admin: true })).admin).toBe(true)
    expect([asked.at(-1)?.init.method, sent('If-Match')]).toEqual(['PATCH', '"now"'])
    answers = [shown, shown]
    await grant({ ...shown, level: 'owner' }, shown)
    expect([asked.at(-1)?.init.method, sent('If-Match')]).toEqual(['PUT', '"now"'])
    answers = [MISSING(), shown]
    await grant(shown, null)
    expect([sent('If-Match'), sent('If-None-Match')]).toEqual([null, '*'])
  })

  it('is left as it is when somebody else was there before', async () => {
    for (const now of [{ ...ann, disabled: true }, { ...ann, groups: [] }, MISSING()]) {
      asked = []
      answers = [now]
      const failure: unknown = await changeUser(ann, { admin: true }).catch((error: unknown) => error)
      expect(failure).toBeInstanceOf(Superseded)
      expect((failure as Superseded).gone).toBe(now instanceof Response)
      expect(asked).toHaveLength(1)
    }
    answers = [shown]
    await expect(grant(shown, null)).rejects.toBeInstanceOf(Superseded)
  })

  it('is left as it is when somebody else is there in between', async () => {
    answers = [ann, new Response('{}', { status: 412 })]
    await expect(changeUser(ann, { admin: true })).rejects.toThrow('Another user has changed this')
  })
})
