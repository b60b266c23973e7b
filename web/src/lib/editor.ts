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
import { Compartment, EditorState, Prec } from '@codemirror/state'
import { EditorView, highlightActiveLine, keymap, lineNumbers } from '@codemirror/view'
import { tags } from '@lezer/highlight'
import type { Schemas } from './api'

type Table = Schemas['Table']

export interface Editor {
  text(): string
  set(text: string): void
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

export function editor(
  host: HTMLElement,
  text: string,
  changed: (text: string) => void,
  run: () => void,
  stop: () => void,
): Editor {
  const root = host.shadowRoot ?? host.attachShadow({ mode: 'open' })
  root.replaceChildren()
  const parent = document.createElement('div')
  parent.style.height = '100%'
  root.append(parent)
  const language = new Compartment()
  const functions = new Compartment()
  const view = new EditorView({
    root,
    parent,
    state: EditorState.create({
      doc: text,
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
        EditorView.contentAttributes.of({ 'aria-label': 'Query. Ctrl Enter runs it, Escape cancels it.' }),
        Prec.highest(
          keymap.of([
            {
              key: 'Mod-Enter',
              run: (target) => {
                closeCompletion(target)
                run()
                return true
              },
            },
            { key: 'Tab', run: acceptCompletion },
          ]),
        ),
        keymap.of([
          ...completionKeymap,
          {
            key: 'Escape',
            run: () => {
              stop()
              return false
            },
          },
          ...defaultKeymap,
          ...historyKeymap,
        ]),
        language.of(sql({ dialect: PostgreSQL })),
        functions.of([]),
        EditorView.updateListener.of((update) => {
          if (update.docChanged) changed(update.state.doc.toString())
        }),
      ],
    }),
  })
  return {
    text: () => view.state.doc.toString(),
    set(next) {
      closeCompletion(view)
      view.dispatch({ changes: { from: 0, to: view.state.doc.length, insert: next } })
    },
    complete(tables, called) {
      const support = sql({ dialect: PostgreSQL, schema: names(tables), upperCaseKeywords: false })
      const options = words(tables, called)
      view.dispatch({
        effects: [
          language.reconfigure(support),
          functions.reconfigure(
            PostgreSQL.language.data.of({
              autocomplete: (context: CompletionContext) => {
                const word = context.matchBefore(/\w+/)
                return word ? { from: word.from, options } : null
              },
            }),
          ),
        ],
      })
    },
    focus: () => view.focus(),
    destroy: () => view.destroy(),
  }
}
