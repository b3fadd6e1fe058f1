/** Drawing on a canvas that stays crisp on any display. */

export interface Surface {
  context: CanvasRenderingContext2D
  /** Size in CSS pixels. */
  width: number
  height: number
}

/** Keeps the bitmap of a canvas at the size it is shown in, and calls `draw` after every change of size. */
export function fitted(canvas: HTMLCanvasElement, draw: () => void): () => void {
  const observer = new ResizeObserver(draw)
  observer.observe(canvas)
  return () => observer.disconnect()
}

/** The cleared context of the canvas, in CSS pixels; null while the canvas has no size. */
export function surface(canvas: HTMLCanvasElement): Surface | null {
  const width = canvas.clientWidth
  const height = canvas.clientHeight
  const context = canvas.getContext('2d')
  if (context === null || width === 0 || height === 0) return null
  const ratio = window.devicePixelRatio || 1
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)]
  if (canvas.width !== w) canvas.width = w
  if (canvas.height !== h) canvas.height = h
  context.setTransform(ratio, 0, 0, ratio, 0, 0)
  context.clearRect(0, 0, width, height)
  return { context, width, height }
}

export const INK = {
  line: '#2c3944',
  text: '#93a1ae',
  accent: '#58c4d6',
  robot: '#e3e9ee',
  stale: '#5b6874',
  ground: '#10161c',
  goal: '#55c08a',
  path: '#e3b052',
}

/** The robot as an arrowhead, pointing along an angle (0 is right, counter-clockwise, radians). */
export function arrow(
  context: CanvasRenderingContext2D,
  x: number,
  y: number,
  angle: number,
  size: number,
  fill = INK.robot,
): void {
  context.save()
  context.translate(x, y)
  context.rotate(-angle)
  context.beginPath()
  context.moveTo(size, 0)
  context.lineTo(-size * 0.7, size * 0.65)
  context.lineTo(-size * 0.35, 0)
  context.lineTo(-size * 0.7, -size * 0.65)
  context.closePath()
  context.fillStyle = fill
  context.fill()
  context.restore()
}
