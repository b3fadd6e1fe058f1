/** H.264 by the browser's own decoder (WebCodecs), which only pages by a secure connection have. */
import type { PictureHeader } from './video'

/** Why a page can't show H.264, or null when it can. */
export function h264Missing(page: { isSecureContext: boolean; VideoDecoder?: unknown }): string | null {
  if (!page.isSecureContext) return 'H.264 needs https: on a page by plain http browsers have no decoder for it.'
  return page.VideoDecoder === undefined ? 'This browser has no decoder for H.264 (WebCodecs).' : null
}

const SEQUENCE_PARAMETERS = 7

/** The codec as browsers name it, from the parameter set of a key frame (Annex B); null when it has none. */
export function codecName(picture: Uint8Array): string | null {
  for (let at = 0; at + 6 < picture.length; at++) {
    const starts = picture[at] === 0 && picture[at + 1] === 0 && picture[at + 2] === 1
    if (!starts || (picture[at + 3]! & 0x1f) !== SEQUENCE_PARAMETERS) continue
    const profile = [...picture.subarray(at + 4, at + 7)]
    return `avc1.${profile.map((byte) => byte.toString(16).padStart(2, '0')).join('')}`
  }
  return null
}

/** A decoder may hold a picture back until the next one comes, which comes only after this one is taken. */
const HELD_MS = 100

export class H264Decoder {
  private readonly decoder: VideoDecoder
  private codec: string | null = null
  /** Pictures inside the decoder, by their timestamp. */
  private readonly inside = new Map<number, { header: PictureHeader; taken: () => void }>()

  /**
   * @param show gets each decoded picture and owns it
   * @param failed told once, when nothing more can be decoded
   */
  constructor(show: (frame: VideoFrame, header: PictureHeader) => void, failed: () => void) {
    this.decoder = new VideoDecoder({
      output: (frame) => {
        const found = this.inside.get(frame.timestamp)
        this.inside.delete(frame.timestamp)
        if (found === undefined) return frame.close()
        show(frame, found.header)
        found.taken()
      },
      error: () => {
        this.letGo()
        failed()
      },
    })
  }

  /** Resolves when the picture was shown, or is nothing to wait for. */
  async decode(header: PictureHeader, body: ArrayBuffer): Promise<void> {
    if (this.decoder.state === 'closed') return
    if (header.key) this.configure(codecName(new Uint8Array(body)))
    // Before the first key frame there is nothing to build on.
    if (this.codec === null) return
    const taken = new Promise<void>((done) => this.inside.set(header.number, { header, taken: done }))
    const type = header.key ? 'key' : 'delta'
    this.decoder.decode(new EncodedVideoChunk({ type, timestamp: header.number, data: body }))
    await Promise.race([taken, new Promise((done) => setTimeout(done, HELD_MS))])
  }

  close(): void {
    this.letGo()
    if (this.decoder.state !== 'closed') this.decoder.close()
  }

  private configure(codec: string | null): void {
    if (codec === null || codec === this.codec) return
    this.codec = codec
    this.letGo()
    this.decoder.configure({ codec, optimizeForLatency: true })
  }

  private letGo(): void {
    for (const { taken } of this.inside.values()) taken()
    this.inside.clear()
  }
}
