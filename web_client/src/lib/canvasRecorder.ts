/** A canvas for unit tests, which notes what is drawn where. */
import type { Surface } from './canvas'

/** What one call draws. */
export interface Mark {
  what: 'rect' | 'image' | 'text' | 'fill' | 'stroke'
  /** Fill or stroke style; empty for an image. */
  colour: string
  alpha: number
  /** Corners and joints in CSS pixels of the canvas, rounded to hundredths; for an arc its centre. */
  points: [number, number][]
  /** Of the arcs among them. */
  radii: number[]
  /** Bitmap of an image, words of a text. */
  content?: unknown
  smooth?: boolean
}

type Matrix = [a: number, b: number, c: number, d: number, e: number, f: number]

/** Only what the portal's drawings call. Its state is saved and restored like that of a real context. */
class RecordingContext {
  fillStyle = '#000000'
  strokeStyle = '#000000'
  globalAlpha = 1
  lineWidth = 1
  lineJoin = 'miter'
  font = ''
  imageSmoothingEnabled = true

  private matrix: Matrix = [1, 0, 0, 1, 0, 0]
  private readonly saved: Partial<RecordingContext>[] = []
  private path: [number, number][] = []
  private radii: number[] = []

  constructor(private readonly marks: Mark[]) {}

  save(): void {
    const { fillStyle, strokeStyle, globalAlpha, lineWidth, lineJoin, font, imageSmoothingEnabled, matrix } = this
    this.saved.push({ fillStyle, strokeStyle, globalAlpha, lineWidth, lineJoin, font, imageSmoothingEnabled, matrix } as Partial<RecordingContext>)
  }

  restore(): void {
    Object.assign(this, this.saved.pop())
  }

  translate(x: number, y: number): void {
    this.multiply([1, 0, 0, 1, x, y])
  }

  rotate(angle: number): void {
    const [c, s] = [Math.cos(angle), Math.sin(angle)]
    this.multiply([c, s, -s, c, 0, 0])
  }

  scale(x: number, y: number): void {
    this.multiply([x, 0, 0, y, 0, 0])
  }

  beginPath(): void {
    this.path = []
    this.radii = []
  }

  moveTo(x: number, y: number): void {
    this.path.push(this.onScreen(x, y))
  }

  lineTo(x: number, y: number): void {
    this.path.push(this.onScreen(x, y))
  }

  arc(x: number, y: number, radius: number): void {
    this.path.push(this.onScreen(x, y))
    this.radii.push(radius)
  }

  closePath(): void {}

  fill(): void {
    this.note('fill', this.fillStyle, this.path)
  }

  stroke(): void {
    this.note('stroke', this.strokeStyle, this.path)
  }

  fillRect(x: number, y: number, width: number, height: number): void {
    this.beginPath()
    this.note('rect', this.fillStyle, this.corners(x, y, width, height))
  }

  drawImage(bitmap: { width: number; height: number }, x: number, y: number): void {
    this.beginPath()
    this.note('image', '', this.corners(x, y, bitmap.width, bitmap.height), { content: bitmap, smooth: this.imageSmoothingEnabled })
  }

  fillText(words: string, x: number, y: number): void {
    this.beginPath()
    this.note('text', this.fillStyle, [this.onScreen(x, y)], { content: words })
  }

  private note(what: Mark['what'], colour: string, points: [number, number][], more: Partial<Mark> = {}): void {
    this.marks.push({ what, colour, alpha: this.globalAlpha, points: [...points], radii: [...this.radii], ...more })
  }

  private corners(x: number, y: number, width: number, height: number): [number, number][] {
    return [
      this.onScreen(x, y),
      this.onScreen(x + width, y),
      this.onScreen(x + width, y + height),
      this.onScreen(x, y + height),
    ]
  }

  private onScreen(x: number, y: number): [number, number] {
    const [a, b, c, d, e, f] = this.matrix
    // Without a negative zero, which is not equal to zero in tests.
    const rounded = (value: number) => Math.round(value * 100) / 100 + 0
    return [rounded(a * x + c * y + e), rounded(b * x + d * y + f)]
  }

  private multiply([a, b, c, d, e, f]: Matrix): void {
    const [p, q, r, s, t, u] = this.matrix
    this.matrix = [p * a + r * b, q * a + s * b, p * c + r * d, q * c + s * d, p * e + r * f + t, q * e + s * f + u]
  }
}

/** A surface of a size in CSS pixels, and the list of what is drawn on it. */
export function recorded(width: number, height: number): { surface: Surface; marks: Mark[] } {
  const marks: Mark[] = []
  const context = new RecordingContext(marks) as unknown as CanvasRenderingContext2D
  return { surface: { context, width, height }, marks }
}
