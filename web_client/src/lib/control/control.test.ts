import { describe, expect, it } from 'vitest'
import {
  firstSuccess,
  holderBadge,
  isYours,
  secondsLeft,
  sentenceOf,
  suppressionText,
  controlState,
  suppressor,
  topOf,
  resumeHint,
  whyLost,
  within,
} from './control'
import type { Control, ControlRequest, Holder } from '../api/types'

const holder = (user: string, you = false): Holder => ({ user, client: 7, since: 1000, you, implicit: false })
const request = (user: string, you = false): ControlRequest => ({ user, client: 7, since: 1000, you, why: '', until: 1030 })

function control(more: Partial<Control> = {}): Control {
  const you = { client: 3, may_control: true, may_resume: false }
  const state = more.request ? 'requested' : more.holder ? 'held' : 'free'
  const nothing = { holder: null, request: null, stopped: null, moving: false, suppressed: [], inhibited: [], limits: {} }
  return { robot: 'r', state, ...nothing, you, ...more }
}

const stands = (state: Control | null, level: 'operator' | 'owner' = 'operator', now = 1010) =>
  controlState(state, 'ann', level, now)

describe('how one stands to control', () => {
  it.each([
    [null, 'unknown'],
    [control(), 'free'],
    [control({ holder: holder('ann', true) }), 'yours'],
    [control({ holder: holder('ann', true), request: request('bob') }), 'asked'],
    [control({ holder: holder('bob') }), 'held'],
    [control({ holder: holder('bob'), request: request('eve') }), 'held'],
    [control({ holder: holder('ann') }), 'elsewhere'],
    [control({ holder: holder('bob'), request: request('ann', true) }), 'waiting'],
  ] as const)('%#', (state, expected) => {
    expect(stands(state)).toBe(expected)
  })

  it('an owner who got no answer may take over, an operator goes on waiting', () => {
    const state = control({ holder: holder('bob'), request: request('ann', true) })
    expect(stands(state, 'owner', 1029)).toBe('waiting')
    expect(stands(state, 'owner', 1030)).toBe('may_take_over')
    expect(stands(state, 'operator', 1030)).toBe('waiting')
  })

  it('whoever asked takes over from a program that answers nobody', () => {
    const program = { ...holder('bob'), implicit: true }
    const state = control({ holder: program, request: request('ann', true) })
    expect(stands(state, 'operator', 1029)).toBe('waiting')
    expect(stands(state, 'operator', 1030)).toBe('may_take_over')
  })

  it('only this connection’s own control counts as one’s own', () => {
    expect(isYours(null)).toBe(false)
    expect(isYours(control({ holder: holder('ann') }))).toBe(false)
    expect(isYours(control({ holder: holder('ann', true) }))).toBe(true)
  })
})

describe('the words', () => {
  const words = (state: Control | null, now = 1010) => sentenceOf(state, stands(state, 'owner', now), now)

  it('say who has control and who wants it', () => {
    expect(words(null)).toBe('Waiting for the state of control.')
    expect(words(control())).toBe('Nobody has control.')
    expect(words(control({ holder: holder('ann', true), request: request('bob') }))).toContain('bob requests it')
    expect(words(control({ holder: holder('bob'), request: request('eve') }))).toBe('bob has control, eve requests it.')
    expect(words(control({ holder: holder('ann') }))).toBe('You have control in another window.')
  })

  it('say whether the holder can still answer', () => {
    const state = control({ holder: holder('bob'), request: request('ann', true) })
    expect(words(state)).toBe('You have requested control from bob.')
    expect(words(state, 1030)).toBe('bob has not answered. You may take over.')
    expect(sentenceOf(state, 'waiting', 1031)).toBe('bob has not answered yet.')
    expect(secondsLeft(state.request!, 1010.2)).toBe(20)
    expect(secondsLeft(state.request!, 2000)).toBe(0)
  })

  it('say why control is gone', () => {
    expect(whyLost(control({ holder: holder('bob') }), false)).toBe('bob has control now.')
    expect(whyLost(control(), false)).toContain('It is free')
    expect(whyLost(control(), true)).toContain('robot’s link')
  })

  it('say who can resume', () => {
    expect(resumeHint(control())).toContain('owner')
    expect(resumeHint(control({ holder: holder('bob') }))).toContain('bob')
  })

  it('of the top bar are short, and none when control is free', () => {
    expect(holderBadge(null)).toBeNull()
    expect(holderBadge(control())).toBeNull()
    expect(holderBadge(control({ holder: holder('ann', true) }))).toBe('You have control')
    expect(holderBadge(control({ holder: holder('bob') }))).toBe('bob has control')
  })
})

describe('topics that others have their hands on', () => {
  const suppressed = [{ resource: '/cmd_vel', ms: 100, sources: [9], by: 'runaway' }]
  const inhibited = [
    { resource: '/scan', ms: 100, hold: true, by: 'olga' },
    { resource: '/odom', ms: 100, hold: false, by: '' },
  ]
  const state = control({ suppressed, inhibited })

  it('are commanded by somebody, unless that is oneself', () => {
    expect(suppressor(state, '/cmd_vel')).toBe('runaway')
    expect(suppressor(control({ suppressed: [{ ...suppressed[0]!, sources: [3] }] }), '/cmd_vel')).toBeNull()
    expect([suppressor(state, '/other'), suppressor(state, null), suppressor(null, '/cmd_vel')]).toEqual([null, null, null])
  })

  it('are told apart by whether they say their last value or nothing', () => {
    expect(suppressionText(state, '/scan')).toBe('held by olga')
    expect(suppressionText(state, '/odom')).toBe('inhibited by another client')
    expect([suppressionText(state, '/other'), suppressionText(state, null), suppressionText(null, '/scan')]).toEqual([null, null, null])
  })
})

describe('limits', () => {
  const NONE = { linear: null, angular: null, linear_acceleration: null, angular_acceleration: null }
  const state = control({ limits: { operator: { ...NONE, linear: 0.4 }, owner: NONE } })

  it('are those of one’s level', () => {
    expect(topOf(state, 'operator')).toEqual({ linear: 0.4, angular: null })
    expect(topOf(state, 'owner')).toEqual({ linear: null, angular: null })
    expect(topOf(state, null)).toEqual({ linear: null, angular: null })
    expect(topOf(null, 'owner')).toEqual({ linear: null, angular: null })
  })

  it('hold what was chosen down, and leave the rest', () => {
    expect(within({ linear: 1, angular: 2 }, topOf(state, 'operator'))).toEqual({ linear: 0.4, angular: 2 })
  })

  it('that make no sense are none', () => {
    const odd = control({ limits: { operator: { ...NONE, linear: Number.NaN, angular: -1 } } })
    expect(topOf(odd, 'operator')).toEqual({ linear: null, angular: null })
  })
})

describe('an order that goes by several ways', () => {
  const refused = (error: unknown) => error instanceof TypeError

  it('is done when one of them does it, whatever becomes of the others', async () => {
    const never = new Promise<string>(() => {})
    expect(await firstSuccess([never, Promise.reject(new Error('no')), Promise.resolve('done')], refused)).toBe('done')
  })

  it('that all fail is told in the words that say most', async () => {
    const ways = [Promise.reject(new Error('no connection')), Promise.reject(new TypeError('not yours'))]
    await expect(firstSuccess(ways, refused)).rejects.toThrow('not yours')
    await expect(firstSuccess([Promise.reject(new Error('no connection'))], refused)).rejects.toThrow('no connection')
  })
})
