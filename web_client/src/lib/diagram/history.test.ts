import { expect, it } from 'vitest'
import { History, MOST_STEPS, type Step } from './history'

function world() {
  const log: string[] = []
  const step = (label: string): Step => ({
    label,
    do: async () => void log.push(`do ${label}`),
    undo: async () => void log.push(`undo ${label}`),
  })
  return { log, step }
}

it('takes steps back and repeats them', async () => {
  const { log, step } = world()
  const history = new History()
  await history.take(step('a'))
  await history.take(step('b'))
  expect([history.undoLabel, history.redoLabel]).toEqual(['b', null])
  await history.undo()
  await history.undo()
  await history.undo()
  expect([history.undoLabel, history.redoLabel]).toEqual([null, 'a'])
  await history.redo()
  expect(log).toEqual(['do a', 'do b', 'undo b', 'undo a', 'do a'])
})

it('forgets steps that were taken back at the next one', async () => {
  const { step } = world()
  const history = new History()
  await history.take(step('a'))
  await history.undo()
  await history.take(step('b'))
  expect([history.undoLabel, history.redoLabel]).toEqual(['b', null])
})

it('stays where it is when a step fails', async () => {
  const { step } = world()
  const history = new History()
  const fails = () => Promise.reject(new Error('refused'))
  await expect(history.take({ ...step('a'), do: fails })).rejects.toThrow('refused')
  expect(history.undoLabel).toBeNull()
  await history.take({ ...step('b'), undo: fails })
  await expect(history.undo()).rejects.toThrow('refused')
  expect([history.undoLabel, history.redoLabel]).toEqual(['b', null])
})

it('carries out one step at a time', async () => {
  const { log, step } = world()
  const history = new History()
  let open = () => {}
  const slow = history.take({ ...step('slow'), do: () => new Promise<void>((resolve) => (open = resolve)).then(() => void log.push('do slow')) })
  const next = history.take(step('next'))
  await Promise.resolve()
  open()
  await Promise.all([slow, next])
  expect(log).toEqual(['do slow', 'do next'])
})

it('keeps a bounded number of steps, and says when labels change', async () => {
  let changes = 0
  const history = new History(() => changes++)
  for (let number = 0; number <= MOST_STEPS; number++) history.note(world().step(String(number)))
  for (let number = 0; number < MOST_STEPS; number++) await history.undo()
  expect([history.undoLabel, changes]).toEqual([null, 2 * MOST_STEPS + 1])
})
