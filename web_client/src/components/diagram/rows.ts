import { type Element, isPart, wholeId } from '../../lib/diagram/model'
import type { DiagramStore } from '../../lib/stores/diagramStore.svelte.ts'

/** Rows of a node that is not unfolded, without opened fields. */
const FEW = 8
const LANES = ['subject', 'action', 'directObject', null]

/** The rows that a node shows, and how many more it has; -1: all are shown, and some can be hidden. */
export function rowsOf(store: DiagramStore, node: string): { rows: Element[]; more: number } {
  const all = store.elementsOf(node)
  if (node.startsWith('role:')) return folded(store, node, [...all].sort((a, b) => lane(a) - lane(b)))
  return folded(store, node, all)
}

function folded(store: DiagramStore, node: string, all: Element[]): { rows: Element[]; more: number } {
  const whole = all.filter((each) => !isPart(each))
  if (whole.length <= FEW) return { rows: all, more: 0 }
  if (store.unfolded.has(node)) return { rows: all, more: -1 }
  const connected = new Set(store.lines.flatMap(({ from, to }) => [from.split('#')[0], to.split('#')[0]]))
  const needed = whole.filter(({ id }) => connected.has(id) || store.opened.has(id))
  const rest = whole.filter((each) => !needed.includes(each)).slice(0, Math.max(0, FEW - needed.length))
  const kept = new Set([...needed, ...rest].map(({ id }) => id))
  const rows = all.filter((each) => kept.has(isPart(each) ? wholeId(each) : each.id))
  return { rows, more: whole.length - kept.size }
}

function lane({ item }: Element): number {
  return LANES.indexOf(item?.lane ?? null)
}
