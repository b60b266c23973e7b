//! The SQL editor. It lives in a shadow root, where its styles need no inline style element that the page's policy forbids.
import {
  acceptCompletion,
  autocompletion,
  closeBrackets,
  closeCompletion,
  completionKeymap,
  type Completion,
  type CompletionContext,
} from '@codemirror/autocomplete'
import { defaultKeymap, history, historyKeymap } from '@codemirror/commands'
import { PostgreSQL, sql, type SQLNamespace } from '@codemirror/lang-sql'
import { bracketMatching, HighlightStyle, syntaxHighlighting } from '@codemirror/language'
import { Compartment, EditorState, Prec, type Extension } from '@codemirror/state'
import { EditorView, highlightActiveLine, keymap, lineNumbers } from '@codemirror/view'
import { tags } from '@lezer/highlight'
import type { Schemas } from './api'

type Table = Schemas['Table']

export interface Editor {
  /** Shows one of several texts, with the cursor and the undoing of each. */
  show(id: string, text: string): void
  /** Puts a name where the cursor is. */
  insert(name: string): void
  /** Where the cursor is. */
  position(): number
  complete(tables: readonly Table[], functions: readonly string[]): void
  focus(): void
  destroy(): void
}

const look = EditorView.theme({
  '&': { height: '100%', fontSize: '14px', color: 'var(--ink)', backgroundColor: 'var(--paper)' },
  '.cm-content': { fontFamily: 'var(--mono)', caretColor: 'var(--ink)', padding: '8px 0' },
  '.cm-scroller': { fontFamily: 'var(--mono)', lineHeight: '1.5' },
  '.cm-gutters': { backgroundColor: 'var(--paper)', color: 'var(--ink-2)', border: 'none' },
  '.cm-activeLine': { backgroundColor: 'transparent' },
  '&.cm-focused': { outline: 'none' },
  '.cm-cursor': { borderLeftColor: 'var(--ink)' },
  '&.cm-focused .cm-selectionBackground, .cm-selectionBackground': { backgroundColor: 'var(--accent-well) !important' },
  '.cm-tooltip': { backgroundColor: 'var(--paper)', color: 'var(--ink)', border: '1px solid var(--ink)' },
  '.cm-tooltip-autocomplete ul li[aria-selected]': { backgroundColor: 'var(--ink)', color: 'var(--paper)' },
  '.cm-tooltip-autocomplete ul li[aria-selected] .cm-completionDetail': { color: 'inherit' },
  '.cm-completionDetail': { color: 'var(--ink-2)', fontStyle: 'normal', marginLeft: '12px' },
})
const colours = HighlightStyle.define([
  { tag: tags.keyword, color: 'var(--accent)' },
  { tag: [tags.string, tags.special(tags.string)], color: 'var(--mark)' },
  { tag: [tags.number, tags.bool, tags.null], color: 'var(--under)' },
  { tag: tags.comment, color: 'var(--ink-2)' },
])

/** Replaces a selection by what is typed. The browser would carry its style over to the text, as an inline style that the
 * page's policy refuses. */
function replaceSelection(event: InputEvent, view: EditorView): boolean {
  const { main, ranges } = view.state.selection
  const text = event.data
  if (event.inputType !== 'insertText' || event.isComposing || !text || main.empty || ranges.length > 1) return false
  event.preventDefault()
  const insert = () =>
    view.state.update(view.state.replaceSelection(text), { userEvent: 'input.type', scrollIntoView: true })
  const handlers = view.state.facet(EditorView.inputHandler)
  if (!handlers.some((handle) => handle(view, main.from, main.to, text, insert))) view.dispatch(insert())
  return true
}

/** Functions and every column, also before a table is named. */
function words(tables: readonly Table[], functions: readonly string[]): Completion[] {
  const columns = new Map<string, { unit: string; comment: string; tables: string[] }>()
  for (const table of tables) {
    for (const column of table.columns) {
      const known = columns.get(column.name)
      if (known) known.tables.push(table.name)
      else columns.set(column.name, { unit: column.unit ?? '', comment: column.comment ?? '', tables: [table.name] })
    }
  }
  return [
    ...functions.map((label) => ({ label, type: 'function', apply: `${label}(` })),
    ...[...columns].map(([label, about]) => ({
      label,
      type: 'property',
      boost: -1,
      detail: about.unit,
      info: `${about.comment}. In ${about.tables.join(', ')}.`,
    })),
  ]
}

function names(tables: readonly Table[]): SQLNamespace {
  return Object.fromEntries(
    tables.map((table) => [
      table.name,
      table.columns.map((column) => ({
        label: column.name,
        type: 'property',
        detail: column.unit ?? '',
        info: column.comment ?? '',
      })),
    ]),
  )
}

/** What the keys in the editor do. */
export interface EditorActions {
  changed(text: string): void
  run(): void
  runAll(): void
  stop(): void
}

export function editor(host: HTMLElement, actions: EditorActions): Editor {
  const root = host.shadowRoot ?? host.attachShadow({ mode: 'open' })
  root.replaceChildren()
  const parent = document.createElement('div')
  parent.style.height = '100%'
  root.append(parent)
  const language = new Compartment()
  const functions = new Compartment()
  let [support, completion] = [sql({ dialect: PostgreSQL }) as Extension, [] as Extension]
  const runs = (run: () => void) => (target: EditorView) => {
    closeCompletion(target)
    run()
    return true
  }
  const stateOf = (doc: string) =>
    EditorState.create({
      doc,
      extensions: [
        lineNumbers(),
        history(),
        bracketMatching(),
        closeBrackets(),
        autocompletion({ icons: false }),
        highlightActiveLine(),
        EditorView.domEventHandlers({ beforeinput: replaceSelection }),
        EditorView.lineWrapping,
        look,
        syntaxHighlighting(colours),
        EditorView.contentAttributes.of({
          'aria-label':
            'Query. Ctrl Enter runs the statement at the cursor, Ctrl Shift Enter all of them, Escape cancels.',
        }),
        Prec.highest(
          keymap.of([
            { key: 'Mod-Enter', run: runs(actions.run), shift: runs(actions.runAll) },
            { key: 'Tab', run: acceptCompletion },
          ]),
        ),
        keymap.of([
          ...completionKeymap,
          {
            key: 'Escape',
            run: () => {
              actions.stop()
              return false
            },
          },
          ...defaultKeymap,
          ...historyKeymap,
        ]),
        language.of(support),
        functions.of(completion),
        EditorView.updateListener.of((update) => {
          if (update.docChanged) actions.changed(update.state.doc.toString())
        }),
      ],
    })
  const view = new EditorView({ root, parent, state: stateOf('') })
  const states = new Map<string, EditorState>()
  let shown = ''
  const reconfigure = () =>
    view.dispatch({ effects: [language.reconfigure(support), functions.reconfigure(completion)] })
  return {
    show(id, text) {
      if (shown) states.set(shown, view.state)
      shown = id
      const known = states.get(id)
      view.setState(known?.doc.toString() === text ? known : stateOf(text))
      reconfigure()
    },
    insert(name) {
      const { to } = view.state.selection.main
      const isInWord = /[\w"]$/.test(view.state.sliceDoc(0, to))
      const insert = isInWord ? ` ${name}` : name
      view.dispatch({ changes: { from: to, insert }, selection: { anchor: to + insert.length }, userEvent: 'input' })
      view.focus()
    },
    position: () => view.state.selection.main.head,
    complete(tables, called) {
      support = sql({ dialect: PostgreSQL, schema: names(tables), upperCaseKeywords: false })
      const options = words(tables, called)
      completion = PostgreSQL.language.data.of({
        autocomplete: (context: CompletionContext) => {
          const word = context.matchBefore(/\w+/)
          return word ? { from: word.from, options } : null
        },
      })
      reconfigure()
    },
    focus: () => view.focus(),
    destroy: () => view.destroy(),
  }
}
