/** Functions on the relay's workers and their jobs, without user interface. */
import { ask, send } from './request'
import type { FunctionList, FunctionStatus, JobStatus } from './types'

/** Tone of each state. */
export const TONES: Record<JobStatus['state'], '' | 'good' | 'warn' | 'bad'> = {
  queued: '',
  running: 'warn',
  done: 'good',
  failed: 'bad',
  cancelled: '',
}

export type ArgumentKind = 'number' | 'integer' | 'text' | 'flag' | 'file' | 'json'

/** One argument of a function, as a field of a form. */
export interface Argument {
  name: string
  kind: ArgumentKind
  required: boolean
  /** What stands in the field at first. */
  initial: string
  hint: string
}

interface Schema {
  $ref?: string
  $defs?: Record<string, Schema>
  type?: string
  contentEncoding?: string
  contentMediaType?: string
  properties?: Record<string, Schema>
  required?: string[]
  default?: unknown
  minimum?: number
  maximum?: number
}

/** The arguments by the schema of a function's signature, in its order. */
export function argumentsOf(schema: Schema): Argument[] {
  const name = schema.$ref?.split('/').at(-1) ?? ''
  const found = schema.$defs?.[name] ?? schema
  const required = new Set(found.required ?? [])
  return Object.entries(found.properties ?? {}).map(([name, each]) => {
    const kind = kindOf(each)
    return { name, kind, required: required.has(name), initial: initialOf(kind, each.default), hint: hintOf(kind, each) }
  })
}

function kindOf(schema: Schema): ArgumentKind {
  if (schema.contentEncoding === 'base64') return 'file'
  if (schema.type === 'number' || schema.type === 'integer') return schema.type
  if (schema.type === 'string') return 'text'
  return schema.type === 'boolean' ? 'flag' : 'json'
}

function initialOf(kind: ArgumentKind, value: unknown): string {
  if (value === undefined || kind === 'file') return ''
  return kind === 'text' ? String(value) : JSON.stringify(value)
}

function hintOf(kind: ArgumentKind, schema: Schema): string {
  if (kind === 'file') return schema.contentMediaType === 'application/x-npy' ? 'array, .npy' : (schema.contentMediaType ?? 'file')
  if (kind === 'json') return 'JSON'
  if (schema.minimum !== undefined && schema.maximum !== undefined) return `${schema.minimum} to ${schema.maximum}`
  return kind === 'flag' ? '' : kind
}

/** What was entered, by the name of the argument: text, or the bytes of a file in base64. */
export type Entered = Record<string, string>

/** The values of a form, or what is wrong with it. Optional arguments that are left empty are left out. */
export function valuesOf(fields: Argument[], entered: Entered): Record<string, unknown> | string {
  const values: Record<string, unknown> = {}
  for (const { name, kind, required, initial } of fields) {
    const text = entered[name] ?? initial
    if (text === '' && (kind !== 'text' || !required)) {
      if (required) return `${name} is missing.`
      continue
    }
    if (kind === 'text' || kind === 'file') values[name] = text
    else {
      const value = jsonOf(text)
      if (value === undefined) return `${name} is not valid JSON.`
      if ((kind === 'number' || kind === 'integer') && typeof value !== 'number') return `${name} must be a number.`
      if (kind === 'integer' && !Number.isInteger(value)) return `${name} must be a whole number.`
      values[name] = value
    }
  }
  return values
}

function jsonOf(text: string): unknown {
  try {
    return JSON.parse(text) as unknown
  } catch {
    return undefined
  }
}

/** The bytes of a file in base64. */
export async function base64(file: Blob): Promise<string> {
  const bytes = new Uint8Array(await file.arrayBuffer())
  const parts: string[] = []
  // Arguments of a call are limited in number.
  for (let at = 0; at < bytes.length; at += 0x8000) parts.push(String.fromCharCode(...bytes.subarray(at, at + 0x8000)))
  return btoa(parts.join(''))
}

/** Whether a function's result is a picture. */
export function givesPicture(found: FunctionStatus | undefined): boolean {
  const result = (found?.result ?? {}) as Schema
  return result.contentMediaType === 'image/jpeg'
}

/** The duration of a job, seconds; null before it runs. */
export function ranFor(job: JobStatus, now: number): number | null {
  if (job.run_seconds !== null) return job.run_seconds
  return job.started === null ? null : Math.max(0, (job.ended ?? now) - job.started)
}

/** A short duration with two digits that count. */
export function duration(seconds: number | null): string {
  if (seconds === null) return '–'
  if (seconds < 0.9995) return `${Math.max(1, Math.round(seconds * 1000))} ms`
  return seconds < 9.95 ? `${seconds.toFixed(1)} s` : `${Math.round(seconds)} s`
}

export async function functions(): Promise<FunctionList> {
  return (await ask('get', '/api/v1/functions')) as FunctionList
}

export async function jobs(): Promise<JobStatus[]> {
  return (await ask('get', '/api/v1/jobs')).jobs as JobStatus[]
}

/** Begins a job.
 *
 * @param robot for which it counts, or empty
 */
export async function run(name: string, version: number, values: Record<string, unknown>, robot: string): Promise<JobStatus> {
  const body = { arguments: values, version, ...(robot === '' ? {} : { robot }) } as never
  return (await ask('post', '/api/v1/functions/{function}', {
    names: { function: name },
    headers: { Prefer: 'respond-async' },
    body,
  })) as JobStatus
}

export async function resultOf(job: string): Promise<unknown> {
  const answer = (await ask('get', '/api/v1/jobs/{job}/result', { names: { job } })) as { result: unknown }
  return answer.result
}

/** Cancels a job, or removes one that has ended. */
export async function removeJob(job: string): Promise<void> {
  await send('delete', '/api/v1/jobs/{job}', { names: { job } })
}
