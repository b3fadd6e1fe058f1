import { expect, it } from 'vitest'
import { GridPainter, type WorkerPort } from './gridPainter'
import type { GridJob, GridPicture } from './gridWorker'

const place = { frame: 'map', resolution: 1, origin: { x: 0, y: 0, heading: 0 } }
const job = (width: number): GridJob => ({ kind: 'map', place, cells: { width, height: 1, data: new Int8Array(width) } })

function painter() {
  const sent: GridJob[] = []
  const drawn: GridPicture[] = []
  const failed: string[] = []
  const port: WorkerPort = { onmessage: null, onerror: null, postMessage: (message: GridJob) => sent.push(message), terminate: () => {} }
  const answer = (data: object) => port.onmessage?.call(port as Worker, { data } as MessageEvent)
  const made = new GridPainter((picture) => drawn.push(picture), (reason) => failed.push(reason), () => port)
  return { made, sent, drawn, failed, answer }
}

it('draws one grid at a time, and of those that wait the newest', () => {
  const { made, sent, drawn, answer } = painter()
  for (const width of [1, 2, 3]) made.paint(job(width))
  expect(sent.map(({ cells }) => cells.width)).toEqual([1])
  answer({ place, levels: [], known: null })
  expect(drawn).toHaveLength(1)
  expect(sent.map(({ cells }) => cells.width)).toEqual([1, 3])
})

it('goes on after a grid that could not be drawn', () => {
  const { made, sent, failed, answer } = painter()
  made.paint(job(1))
  made.paint(job(2))
  answer({ failed: 'too large' })
  expect(failed).toEqual(['too large'])
  expect(sent).toHaveLength(2)
})
