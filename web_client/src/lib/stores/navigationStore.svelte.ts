/** Goals of this page for the robot's actions navigate_to_pose and follow_waypoints (Nav2). */
import { actions as fetchActions } from '../api/api'
import type { Provided } from '../api/types'
import {
  type Cause,
  ended,
  FOLLOW_WAYPOINTS,
  goalMessage,
  type GoalEnd,
  type GoalPose,
  NAVIGATE_TO_POSE,
  progress,
  SUCCEEDED,
  waypointsMessage,
} from '../map/navigation'
import type { FollowWaypointsFeedback, NavigateToPoseFeedback } from '../ros/messages'
import type { SentGoal } from '../ros/robotLink'
import type { Cockpit } from './cockpitStore.svelte.ts'

export class NavigationStore {
  /** Actions that take goals, as far as the user may use them; null before the relay sent them. */
  actions = $state.raw<Provided[] | null>(null)
  /** Whether goals are collected in a list. */
  listing = $state(false)
  /** The list, in the order in which it is driven. */
  targets = $state.raw<GoalPose[]>([])
  cancelling = $state(false)
  /** How the last goal ended, in words. */
  words = $state<string | null>(null)
  succeeded = $state(false)

  private chosen = $state<string | null>(null)
  /** The first action that takes a list. */
  private listAction = $state.raw<Provided | null>(null)
  /** Targets of the goal under way, and the number of the one that the robot drives to. */
  private route = $state.raw<GoalPose[]>([])
  private current = $state(0)
  private feedback = $state.raw<Partial<NavigateToPoseFeedback>>({})
  private sent: SentGoal | null = null
  private stoppedMeanwhile = false

  readonly action = $derived.by(() => this.actions?.find(({ name }) => name === this.chosen) ?? this.actions?.[0] ?? null)
  /** The pose that the robot drives to. */
  readonly goal = $derived(this.route[this.current] ?? null)
  readonly takesLists = $derived(this.listAction !== null)
  readonly facts = $derived(
    this.route.length > 1 ? [`target ${this.current + 1} of ${this.route.length}`] : progress(this.feedback),
  )
  /** Why this page may not set a goal; null if it may. */
  readonly blocked = $derived.by(() => this.whyNot())

  /** @param over called when the goal under way has ended */
  constructor(
    private readonly cockpit: Cockpit,
    private readonly over: () => void,
  ) {}

  chooseAction(action: string): void {
    this.chosen = action
  }

  async refresh(): Promise<void> {
    try {
      const { name } = this.cockpit
      const [found, lists] = await Promise.all([fetchActions(name, NAVIGATE_TO_POSE), fetchActions(name, FOLLOW_WAYPOINTS)])
      if (JSON.stringify(found) !== JSON.stringify(this.actions)) this.actions = found
      if (lists[0]?.name !== this.listAction?.name) this.listAction = lists[0] ?? null
    } catch {
      // The request is repeated soon; a lost link is shown elsewhere.
    }
  }

  /** Adds a goal to the list, or sends it. A goal under way is replaced, as Nav2 does. */
  choose(goal: GoalPose): void {
    if (this.listing) {
      this.targets = [...this.targets, goal]
    } else if (this.action !== null) {
      this.begin<NavigateToPoseFeedback>(this.action, NAVIGATE_TO_POSE, goalMessage(goal), [goal], (values) => (this.feedback = values))
    }
  }

  /** Has the list driven. */
  sendList(): void {
    const { listAction, targets } = this
    if (listAction === null || targets.length === 0) return
    this.begin<FollowWaypointsFeedback>(listAction, FOLLOW_WAYPOINTS, waypointsMessage(targets), targets, (values) => {
      if (values.current_waypoint !== undefined) this.current = values.current_waypoint
    })
  }

  private begin<F>(action: Provided, type: string, message: object, route: GoalPose[], onFeedback: (values: Partial<F>) => void): void {
    if (this.blocked !== null) return
    this.words = null
    this.succeeded = this.cancelling = this.stoppedMeanwhile = false
    this.feedback = {}
    try {
      const sent = this.cockpit.link.sendGoal<F>(action.name, type, message, (values) => {
        if (this.sent === sent) onFeedback(values)
      })
      this.sent = sent
      this.current = 0
      this.route = route
      sent.result.then(
        (end) => this.end(sent, () => this.endWords(end)),
        () => this.end(sent, () => 'The connection was lost. The robot cancels the goal.'),
      )
    } catch (error) {
      this.words = error instanceof Error ? error.message : String(error)
    }
  }

  cancel(): void {
    this.cancelling = true
    this.sent?.cancel()
  }

  /** Notes that the robot was stopped; the result of the goal comes later. */
  noteStop(): void {
    this.stoppedMeanwhile = true
  }

  private end(sent: SentGoal, words: () => string): void {
    if (this.sent !== sent) return
    this.words = words()
    if (this.succeeded && this.route.length > 1) this.targets = []
    this.sent = null
    this.route = []
    this.cancelling = false
    this.feedback = {}
    this.over()
  }

  private endWords(end: GoalEnd): string {
    this.succeeded = end.status === SUCCEEDED
    return ended(end, this.cause())
  }

  private cause(): Cause {
    if (this.stoppedMeanwhile) return 'robot_stopped'
    if (this.cancelling) return 'page_cancelled'
    return this.cockpit.controlStore.isMine ? null : 'control_lost'
  }

  private whyNot(): string | null {
    const { cockpit } = this
    const { controlStore } = cockpit
    if (cockpit.offline) return 'The robot is offline.'
    if (cockpit.linkState !== 'open' || cockpit.level === null) return 'Waiting for the connection.'
    if (!controlStore.mayControl) return 'You are a viewer. Setting goals needs the level operator; ask an administrator.'
    if (this.actions === null) return 'Waiting for the list of actions.'
    if (this.action === null) return 'This robot has no navigate_to_pose action, so no goals can be set here.'
    if (controlStore.control === null) return 'Waiting for the state of control.'
    if (controlStore.stopped !== null) return 'The robot is stopped. It takes no goals until it is resumed.'
    if (controlStore.isMine) return null
    if (controlStore.state === 'free') return 'Take control to set a goal.'
    return `${controlStore.sentence} Only the holder of control can set goals; request it in the Drive panel.`
  }
}
