/** Pipes of topics and services of robots, and ports and functions of programs, without user interface. */
import { ask, send } from './request'
import type { NewPipe, PipeStatus, ProgramInfo } from './types'

/** Tone of each state (SPEC 1.17). */
export const TONES: Record<PipeStatus['state'], '' | 'good' | 'warn' | 'bad'> = {
  running: 'good',
  waiting: 'warn',
  refused: 'bad',
  stopped: '',
}

/** What a user enters for a new pipe. */
export interface PipeForm {
  name: string
  sourceRobot: string
  sourceTopic: string
  targetRobot: string
  targetTopic: string
  /** One `from = to` a line; none: whole messages. */
  fields: string
  rate: number | null
}

/** A port or function of a program, as users write it. */
const PROGRAM = /^programs\/(\w+)\/(port|function)s\/(\w+)$/
const FIELD = /^([^=*+]+)=([^=*+]+?)(?:\*(-?[\d.]+))?(?:\+(-?[\d.]+))?$/

/** The pipe of a form, or what is wrong with it. */
export function pipeOf(form: PipeForm): NewPipe | string {
  if (!/^[a-z][a-z0-9_-]{0,62}$/.test(form.name)) return 'A name begins with a small letter, and has small letters, digits, - and _.'
  const [from, to] = [form.sourceTopic.trim(), form.targetTopic.trim()]
  for (const [robot, name] of [[form.sourceRobot, from], [form.targetRobot, to]] as const) {
    if (PROGRAM.test(name)) continue
    if (robot === '') return 'Choose both robots.'
    if (!name.startsWith('/')) return 'Topics begin with a /, such as /scan. A port of a program is written as programs/lamp/ports/power.'
  }
  const fields: NewPipe['fields'] = []
  for (const line of form.fields.split('\n').map((each) => each.replaceAll(/\s/g, ''))) {
    if (line === '') continue
    const found = FIELD.exec(line)
    if (found === null) return `'${line}' is no field: write it as axes[1] = linear.x * 0.5`
    fields.push({ source: found[1]!, target: found[2]!, scale: Number(found[3] ?? 1), offset: Number(found[4] ?? 0) })
  }
  return {
    name: form.name,
    source: endOf(form.sourceRobot, from),
    target: endOf(form.targetRobot, to),
    fields,
    rate: form.rate ?? 0,
  }
}

/** An end of a pipe: a topic, a service if its name ends with (), an action if it ends with {}, or a port or function of a program. */
function endOf(robot: string, name: string): NewPipe['source'] {
  const found = PROGRAM.exec(name)
  if (found !== null) return { program: found[1]!, [found[2]!]: found[3]! }
  if (name.endsWith('()')) return { robot, service: name.slice(0, -2) }
  return name.endsWith('{}') ? { robot, action: name.slice(0, -2) } : { robot, topic: name }
}

/** An end of a pipe as users write it. */
export function endText({ robot, topic, service, action, program, port, function: called }: NewPipe['source']): string {
  if (program) return `programs/${program}/${port ? `ports/${port}` : `functions/${called}`}`
  return `${robot}:${topic || (action ? `${action}{}` : `${service}()`)}`
}

/** The caller's pipes, by name. */
export async function pipes(): Promise<PipeStatus[]> {
  return (await ask('get', '/api/v1/pipes')).pipes as PipeStatus[]
}

/** Programs of the caller that are connected by ICPI. */
export async function programs(): Promise<ProgramInfo[]> {
  return (await ask('get', '/api/v1/programs')).programs
}

export async function addPipe(body: NewPipe): Promise<PipeStatus> {
  return (await ask('post', '/api/v1/pipes', { body })) as PipeStatus
}

export async function orderPipe(pipe: string, action: 'start' | 'stop'): Promise<PipeStatus> {
  return (await ask('post', '/api/v1/pipes/{pipe}/{action}', { names: { pipe, action } })) as PipeStatus
}

export async function removePipe(pipe: string): Promise<void> {
  await send('delete', '/api/v1/pipes/{pipe}', { names: { pipe } })
}
