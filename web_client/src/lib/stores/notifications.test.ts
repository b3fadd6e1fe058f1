import { beforeEach, describe, expect, it, vi } from 'vitest'
import { isOn, notify, type Place, turn, whyNot } from './notifications'
import type { Alert } from '../api/types'

let shown: string[]
let answer: NotificationPermission

function place(permission: NotificationPermission, secure = true): Place {
  class Shown {
    static permission = permission
    static requestPermission = vi.fn(async () => (Shown.permission = answer))
    constructor(words: string) {
      shown.push(words)
    }
  }
  return { isSecureContext: secure, Notification: Shown as unknown as typeof Notification }
}

beforeEach(() => {
  shown = []
  answer = 'granted'
  const kept = new Map<string, string>()
  vi.stubGlobal('localStorage', {
    getItem: (key: string) => kept.get(key) ?? null,
    setItem: (key: string, value: string) => kept.set(key, value),
  })
})

const alert = { id: 'a', robot: 'rover', text: 'it is offline', kind: 'offline', level: 'error', state: 'open' } as Alert

describe('notifications', () => {
  it('are not shown before they were turned on, nor asked for by themselves', () => {
    const here = place('default')
    expect(notify([alert], here, () => false)).toBe(false)
    expect(here.Notification!.requestPermission).not.toHaveBeenCalled()
  })

  it('are shown once the user has agreed, unless the page is in front', async () => {
    const here = place('default')
    expect(await turn(true, here)).toBe(true)
    expect(isOn(here)).toBe(true)
    notify([alert], here, () => true)
    expect(shown).toEqual([])
    notify([alert], here, () => false)
    expect(shown).toEqual(['rover: it is offline'])
  })

  it('are one for many alerts', async () => {
    const here = place('granted')
    await turn(true, here)
    notify(Array.from({ length: 100 }, (_, i) => ({ ...alert, id: `${i}` })), here, () => false)
    expect(shown).toEqual(['rover: it is offline, and 99 more'])
  })

  it('stay off when the user refuses, and go off again', async () => {
    answer = 'denied'
    const here = place('default')
    expect(await turn(true, here)).toBe(false)
    const other = place('granted')
    await turn(true, other)
    await turn(false, other)
    expect(notify([alert], other, () => false)).toBe(false)
  })

  it('say why there are none', () => {
    expect(whyNot(place('default', false))).toContain('https')
    expect(whyNot({ isSecureContext: true })).toContain('shows no notifications')
    expect(whyNot(place('denied'))).toContain('settings')
    expect(whyNot(place('granted'))).toBeNull()
  })

  it('that the browser forbids to pages are done without', async () => {
    const here = place('granted')
    await turn(true, here)
    const forbidding = { ...here, Notification: Object.assign(() => { throw new TypeError('Illegal constructor') }, { permission: 'granted' }) }
    expect(notify([alert], forbidding as unknown as Place, () => false)).toBe(false)
  })
})
