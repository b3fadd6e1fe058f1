/** Fields of messages by their type definitions, and which values can be carried to which field. */

/** One type in the answer of `/rosapi/message_details`. */
export interface TypeDef {
  type: string
  fieldnames: string[]
  fieldtypes: string[]
  /** -1: one value, 0: a list of any length, else the length. */
  fieldarraylen: number[]
}

/** A field that holds one number, boolean or string. */
export interface Field {
  /** As pipes write it: `axes[0]`, `twist.linear.x`. */
  path: string
  /** Basic type, such as `float64`. */
  type: string
  /** Whether it is a value in a list, which can't be written alone. */
  indexed: boolean
}

/** Values of one list that are shown. */
export const MOST_OF_LIST = 8
/** Fields of one message that are shown. */
export const MOST_FIELDS = 60
const DEEPEST = 6

/** rosapi has the names of IDL for some types. */
const NAMES: Record<string, string> = { double: 'float64', float: 'float32', boolean: 'bool', octet: 'byte' }

/** Definitions with the names of types that ROS uses. */
export function inRosNames(definitions: TypeDef[]): TypeDef[] {
  return definitions.map((each) => ({ ...each, fieldtypes: each.fieldtypes.map((type) => NAMES[type] ?? type) }))
}

/** Fields of a message, depth first. The first definition is that of the message.
 *
 * @param value a message, which shows how long lists of any length are
 */
export function fieldsOf(definitions: TypeDef[], value: unknown = undefined): Field[] {
  const types = new Map(definitions.map((each) => [each.type, each]))
  const found: Field[] = []

  function walk(type: string, path: string, at: unknown, indexed: boolean, depth: number): void {
    const definition = types.get(type)
    if (definition === undefined) {
      if (found.length < MOST_FIELDS) found.push({ path, type, indexed })
      return
    }
    if (depth > DEEPEST) return
    definition.fieldnames.forEach((name, index) => {
      const [inner, length] = [definition.fieldtypes[index]!, definition.fieldarraylen[index]!]
      const next = path === '' ? name : `${path}.${name}`
      const now = isRecord(at) ? at[name] : undefined
      if (length < 0) return walk(inner, next, now, indexed, depth + 1)
      if (['byte', 'uint8', 'char'].includes(inner)) return
      const known = length > 0 ? length : Array.isArray(now) ? now.length : 0
      for (let item = 0; item < Math.min(known, MOST_OF_LIST); item++) {
        walk(inner, `${next}[${item}]`, Array.isArray(now) ? now[item] : undefined, true, depth + 1)
      }
    })
  }

  const [first] = definitions
  if (first !== undefined) walk(first.type, '', value, false, 0)
  return found
}

/** Basic type of a field; null where it is not known. */
export function typeAt(definitions: TypeDef[], path: string): string | null {
  const types = new Map(definitions.map((each) => [each.type, each]))
  let type = definitions[0]?.type ?? null
  for (const step of path.split(/[.[]/).filter((each) => !each.endsWith(']'))) {
    const definition: TypeDef | undefined = type === null ? undefined : types.get(type)
    const index = definition?.fieldnames.indexOf(step) ?? -1
    if (definition === undefined || index < 0) return null
    type = definition.fieldtypes[index]!
  }
  return type
}

/** The value of a field within a message; undefined where there is none. */
export function valueAt(message: unknown, path: string): unknown {
  if (path === '') return message
  let value = message
  for (const step of path.replaceAll(/\[(\d+)\]/g, '.$1').split('.')) {
    if (typeof value !== 'object' || value === null) return undefined
    value = (value as Record<string, unknown>)[step]
  }
  return value
}

/** The message in which one field has a value. Returns null for a value in a list. */
export function messageWith(path: string, value: unknown): unknown {
  if (path === '') return value
  if (path.includes('[')) return null
  return path.split('.').reduceRight<unknown>((inner, step) => ({ [step]: inner }), value)
}

const TEXTS = new Set(['string', 'wstring'])

/** A type for people. */
export function typeInWords(type: string): string {
  if (TEXTS.has(type)) return 'text'
  if (type === 'bool') return 'yes or no'
  return /^u?int|^float|^byte|^char/.test(type) ? 'a number' : type
}

/** Why values of one basic type can't become values of another; null if they can (docs/guides/pipes.md). */
export function misfit(source: Pick<Field, 'path' | 'type'>, target: Pick<Field, 'path' | 'type' | 'indexed'>): string | null {
  if (target.indexed) return `${target.path} is a value in a list, which can't be set alone.`
  if (TEXTS.has(source.type) && !TEXTS.has(target.type)) {
    return `${source.path} is text and ${target.path} is ${typeInWords(target.type)}. On the page Pipes, a table can say which text means what.`
  }
  return null
}

/** A value as text, short enough for a row. */
export function short(value: unknown): string {
  if (value === undefined) return '–'
  if (typeof value === 'number') return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4)))
  if (typeof value === 'boolean') return value ? 'true' : 'false'
  if (typeof value === 'object' && value !== null && Object.keys(value).join() === 'data') return short((value as { data: unknown }).data)
  const text = typeof value === 'string' ? value : JSON.stringify(value)
  return text.length > 40 ? `${text.slice(0, 39)}…` : text
}

/** What was typed, as a value of a basic type. Throws an Error in words. */
export function parsed(text: string, type: string | null): unknown {
  if (type !== null && TEXTS.has(type)) return text
  const lower = text.trim().toLowerCase()
  if (type === 'bool') {
    if (['true', '1', 'on', 'yes'].includes(lower)) return true
    if (['false', '0', 'off', 'no'].includes(lower)) return false
    throw new Error(`'${text}' is neither true nor false.`)
  }
  if (type !== null && typeInWords(type) === 'a number') {
    const number = Number(lower.replace(',', '.'))
    if (lower === '' || !Number.isFinite(number)) throw new Error(`'${text}' is no number.`)
    return number
  }
  try {
    return JSON.parse(text)
  } catch {
    if (type === null && !/^[[{]/.test(text.trim())) return text
    throw new Error('This is no JSON. Write a message as {"data": 1}.')
  }
}

function isRecord(value: unknown): value is Record<string, unknown> {
  return typeof value === 'object' && value !== null
}
