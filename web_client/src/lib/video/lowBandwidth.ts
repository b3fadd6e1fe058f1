/** Detects that a viewer's link is too slow for H.264, so that JPEG would show more frames (SPEC 1.8). */
import type { PictureHeader, Playing } from '../ros/messages'

const SPAN_MS = 10_000
/** Frames per second below which a run of key frames alone is no coincidence. */
const FEW = 1
/** Factor by which the camera's rate exceeds the received rate. */
const TIMES = 4
/** Share of key frames that counts as nearly all. */
const KEYS = 0.8

/** Frames per second that could come; 0: unknown. */
export function possibleFps(playing: Pick<Playing, 'fps' | 'source_fps'> | null): number {
  const rates = [playing?.fps ?? 0, playing?.source_fps ?? 0].filter((rate) => rate > 0)
  return rates.length > 0 && playing!.source_fps > 0 ? Math.min(...rates) : 0
}

/** Detects a link that is too slow for H.264: it then carries mostly key frames, at growing intervals. */
export class LowBandwidthDetector {
  private came: { atMs: number; key: boolean }[] = []

  /** A frame came; returns whether the link has been too slow for ten seconds.
   *
   * @param perSecond frames per second that could come, 0: unknown
   */
  mark({ key }: Pick<PictureHeader, 'key'>, nowMs: number, perSecond: number): boolean {
    this.came.push({ atMs: nowMs, key })
    // The last frame before the window stays, as its beginning.
    while (this.came.length > 1 && this.came[1]!.atMs <= nowMs - SPAN_MS) this.came.shift()
    const [first, ...others] = this.came
    const spanMs = nowMs - first!.atMs
    if (spanMs < SPAN_MS || others.length < 2) return false
    const rate = (others.length * 1000) / spanMs
    const keys = others.filter((each) => each.key).length / others.length
    return keys >= KEYS && rate < FEW && perSecond >= TIMES * rate
  }

  reset(): void {
    this.came = []
  }
}
