/** Drawings of the cockpit: scan and trail. */
import { arrow, INK, type Surface } from './canvas'
import { view } from './ros/odometry'
import { rings } from './ros/scan'

/** Draws scan points with the robot in the centre; forward is up.
 *
 * @param points pairs x, y in metres
 * @param radiusM distance from the centre to the nearest edge, metres
 */
export function drawScan(surface: Surface, points: Float32Array, radiusM: number, stale: boolean): void {
  const { context: c, width, height } = surface
  const [cx, cy] = [width / 2, height / 2]
  const scale = (Math.min(width, height) / 2 - 6) / radiusM
  c.lineWidth = 1
  c.strokeStyle = INK.line
  c.fillStyle = INK.text
  c.font = '11px system-ui, sans-serif'
  for (const ring of rings(radiusM)) {
    c.beginPath()
    c.arc(cx, cy, ring * scale, 0, 2 * Math.PI)
    c.stroke()
    c.fillText(`${Number(ring.toFixed(2))} m`, cx + 4, cy - ring * scale + 12)
  }
  cross(surface, cx, cy)
  c.fillStyle = stale ? INK.stale : INK.accent
  for (let i = 0; i < points.length; i += 2) {
    const [x, y] = [cx - points[i + 1]! * scale, cy - points[i]! * scale]
    c.fillRect(x - 1.25, y - 1.25, 2.5, 2.5)
  }
  arrow(c, cx, cy, Math.PI / 2, 9)
}

function cross({ context: c, width, height }: Surface, x: number, y: number): void {
  c.beginPath()
  c.moveTo(x, 0)
  c.lineTo(x, height)
  c.moveTo(0, y)
  c.lineTo(width, y)
  c.stroke()
}

/** Draws the path of the robot; x to the right, y up, as in the odometry frame. */
export function drawTrail(surface: Surface, trail: [number, number][], heading: number, stale: boolean): void {
  const { context: c, width, height } = surface
  const { centreX, centreY, half } = view(trail)
  const scale = (Math.min(width, height) / 2 - 10) / half
  const px = (x: number) => width / 2 + (x - centreX) * scale
  const py = (y: number) => height / 2 - (y - centreY) * scale
  drawGrid(surface, px, py, scale)
  c.strokeStyle = stale ? INK.stale : INK.accent
  c.lineWidth = 2
  c.lineJoin = 'round'
  c.beginPath()
  trail.forEach(([x, y], i) => (i === 0 ? c.moveTo(px(x), py(y)) : c.lineTo(px(x), py(y))))
  c.stroke()
  const last = trail.at(-1)
  if (last) arrow(c, px(last[0]), py(last[1]), heading, 8)
}

function drawGrid(
  { context: c, width, height }: Surface,
  px: (x: number) => number,
  py: (y: number) => number,
  scale: number,
): void {
  const step = [0.5, 1, 2, 5, 10, 20, 50].find((s) => s * scale >= 28) ?? 100
  c.strokeStyle = INK.line
  c.lineWidth = 1
  c.beginPath()
  for (let x = Math.ceil((0 - px(0)) / scale / step) * step; px(x) <= width; x += step) {
    c.moveTo(px(x), 0)
    c.lineTo(px(x), height)
  }
  for (let y = Math.ceil((py(0) - height) / scale / step) * step; py(y) >= 0; y += step) {
    c.moveTo(0, py(y))
    c.lineTo(width, py(y))
  }
  c.stroke()
  c.fillStyle = INK.text
  c.font = '11px system-ui, sans-serif'
  c.fillText(`grid ${step} m`, 8, height - 8)
}
