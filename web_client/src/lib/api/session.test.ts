import { afterEach, beforeEach, expect, it, vi } from 'vitest'
import { Checks, turn } from './session'
import type { Session } from './types'

const session = (user: string, more: Partial<Session> = {}): Session => ({ user, admin: false, realm: 'lab', ...more })

it.each([
  [null, null, 'same'],
  [session('ann'), session('ann'), 'same'],
  [session('ann'), session('ann', { admin: true }), 'same'],
  [null, session('ann'), 'in'],
  [session('ann'), null, 'out'],
  [session('ann'), session('bob'), 'other'],
  [session('ann'), session('ann', { realm: 'elsewhere' }), 'other'],
] as const)('knows what has become of a session: %o, %o: %s', (shown, now, what) => {
  expect(turn(shown, now)).toBe(what)
})

let answers: { resolve(now: Session | null): void; reject(error: Error): void }[]
const take = vi.fn<(now: Session | null) => void>()
let checks: Checks

beforeEach(() => {
  vi.useFakeTimers()
  answers = []
  take.mockClear()
  checks = new Checks(
    () => new Promise<Session | null>((resolve, reject) => answers.push({ resolve, reject })),
    take,
  )
})

afterEach(() => {
  vi.useRealTimers()
})

it('hands on who is logged in', async () => {
  checks.refresh()
  answers[0]!.resolve(session('bob'))
  await vi.advanceTimersByTimeAsync(0)
  expect(take).toHaveBeenCalledExactlyOnceWith(session('bob'))
})

it('asks one question at a time, and takes no answer that may be older than its reason', async () => {
  for (let i = 0; i < 5; i++) checks.refresh()
  expect(answers).toHaveLength(1)
  answers[0]!.resolve(session('ann'))
  await vi.advanceTimersByTimeAsync(0)
  expect(take).not.toHaveBeenCalled()
  expect(answers).toHaveLength(2)
  answers[1]!.resolve(session('bob'))
  await vi.advanceTimersByTimeAsync(0)
  expect(take).toHaveBeenCalledExactlyOnceWith(session('bob'))
  expect(answers).toHaveLength(2)
})

it('takes no answer that is older than a login here', async () => {
  checks.refresh()
  checks.known()
  answers[0]!.resolve(null)
  await vi.advanceTimersByTimeAsync(0)
  expect(take).not.toHaveBeenCalled()
  expect(answers).toHaveLength(2)
})

it('asks again until there is an answer', async () => {
  checks.refresh()
  for (let i = 0; i < 3; i++) {
    answers.at(-1)!.reject(new Error('The relay does not answer.'))
    await vi.advanceTimersByTimeAsync(3000)
  }
  expect(answers).toHaveLength(4)
  answers[3]!.resolve(null)
  await vi.advanceTimersByTimeAsync(60_000)
  expect(take).toHaveBeenCalledExactlyOnceWith(null)
  expect(answers).toHaveLength(4)
})
