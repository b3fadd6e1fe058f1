/** Files of robots, and uploads of them that go on after a cut, without user interface. */
import { Sha256 } from '../sha256'
import { addressOf, ask, Refusal, send, Unreachable } from './request'
import type { FileInfo, FilePage, UploadInfo } from './types'

const FILE = '/api/v1/robots/{robot}/files/{name}'
const MIB = 2 ** 20
/** Largest part (SPEC 1.22), and the first one. */
const MOST_BYTES = 8 * MIB
export const FIRST_BYTES = MIB / 2
/** Waits before a part is sent again. */
const RETRY_MS = [500, 1000, 2000, 4000, 8000]

export async function files(robot: string, prefix: string, after: string): Promise<FilePage> {
  return (await ask('get', '/api/v1/robots/{robot}/files', { names: { robot }, query: { prefix, after } })) as FilePage
}

export function fileAddress(robot: string, file: FileInfo): string {
  return addressOf(FILE, { robot, name: file.name }, { sha256: file.sha256 })
}

export async function deleteFile(robot: string, file: FileInfo): Promise<void> {
  await send('delete', FILE, { names: { robot, name: file.name }, query: { sha256: file.sha256 } })
}

/** The name of a dropped file below a folder: without empty parts. */
export function nameBelow(folder: string, file: string): string {
  return [...folder.split('/'), ...file.split('/')].map((each) => each.trim()).filter((each) => each !== '').join('/')
}

/** Size of the next part: about two seconds long, so that a cut costs little, and no part is too slow for the relay. */
export function nextSize(size: number, ms: number): number {
  if (ms < 1000) return Math.min(MOST_BYTES, size * 2)
  return ms > 4000 ? Math.max(64 * 1024, size / 2) : size
}

async function hash(file: Blob, signal: AbortSignal, progress: (share: number) => void): Promise<string> {
  const sum = new Sha256()
  for (let at = 0; at < file.size; at += 4 * MIB) {
    signal.throwIfAborted()
    sum.update(new Uint8Array(await file.slice(at, at + 4 * MIB).arrayBuffer()))
    progress(Math.min(1, (at + 4 * MIB) / file.size))
  }
  return sum.hex()
}

export type UploadStep = 'reading' | 'sending'

interface Upload {
  robot: string
  name: string
  file: Blob & { lastModified?: number }
  signal: AbortSignal
  /** @param share of the step, 0 to 1 */
  progress: (step: UploadStep, share: number) => void
  wait?: (ms: number) => Promise<void>
}

/** Uploads a file in parts; what the relay has already is not sent again.
 *
 * @throws Refusal, Unreachable, or the reason of the signal
 */
export async function upload({ robot, name, file, signal, progress, wait = pause }: Upload): Promise<FileInfo> {
  const sha256 = await hash(file, signal, (share) => progress('reading', share))
  const modified = (file.lastModified ?? Date.now()) / 1000
  let [received, size, failures, known] = [0, FIRST_BYTES, 0, false]
  for (;;) {
    signal.throwIfAborted()
    progress('sending', file.size === 0 ? 0 : received / file.size)
    const stop = known || file.size === 0 ? Math.min(file.size, received + size) : received
    const range = stop > received ? `bytes ${received}-${stop - 1}/${file.size}` : `bytes */${file.size}`
    const begun = performance.now()
    try {
      const answer = (await ask('put', FILE, {
        names: { robot, name },
        query: { sha256, modified },
        headers: { 'Content-Range': range },
        raw: file.slice(received, stop),
        signal,
      })) as FileInfo | UploadInfo
      if ('sha256' in answer) return answer
      if (known) size = nextSize(size, performance.now() - begun)
      // A relay that refuses each part, and says each time where to go on, is not asked for ever.
      if (answer.received > received) failures = 0
      ;[received, known] = [answer.received, true]
    } catch (error) {
      signal.throwIfAborted()
      if (!passes(error, known) || failures >= RETRY_MS.length) throw error
      await wait(RETRY_MS[failures]!)
      ;[failures, known] = [failures + 1, false]
    }
  }
}

/** Whether an upload may go on later: the link is cut, the relay is busy, or it has lost what had arrived (409).
 *
 * @param begun whether the relay has taken the upload, so that no quota forbids it
 */
function passes(error: unknown, begun: boolean): boolean {
  if (error instanceof Unreachable) return true
  return error instanceof Refusal && (error.status === 429 || error.status === 503 || (error.status === 409 && begun))
}

function pause(ms: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, ms))
}
