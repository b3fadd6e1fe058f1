/** Whether H.264 is too much for this viewer's link, so that each picture as JPEG would show more (protocol/SPEC.md 1.8). */
import type { PictureHeader, Playing } from './video'

const SPAN_MS = 10_000
/** Pictures per second below which nothing else but key frames is no chance. */
const FEW = 1
/** The camera gives so many times more than comes here. */
const TIMES = 4
/** Nearly all of them. */
const KEYS = 0.8

/** Pictures per second that could come; 0: not known. */
export function possibleFps(playing: Pick<Playing, 'fps' | 'source_fps'> | null): number {
  const rates = [playing?.fps ?? 0, playing?.source_fps ?? 0].filter((rate) => rate > 0)
  return rates.length > 0 && playing!.source_fps > 0 ? Math.min(...rates) : 0
}

/** Looks at what comes of H.264: who takes too long for it gets little but key frames, and these ever more rarely. */
export class ThinLink {
  private came: { atMs: number; key: boolean }[] = []

  /** A picture came; returns whether the link has been too thin for ten seconds.
   *
   * @param perSecond that could come, 0: not known
   */
  mark({ key }: Pick<PictureHeader, 'key'>, nowMs: number, perSecond: number): boolean {
    this.came.push({ atMs: nowMs, key })
    // The last one from before the span stays: it is where the span begins.
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
