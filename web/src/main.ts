//! Starts the pages.
import { mount } from 'svelte'
import './app.css'
import App from './App.svelte'
import { openLake } from './lib/lake.svelte'
import { follow } from './lib/router.svelte'

follow()
openLake()
mount(App, { target: document.getElementById('app') as HTMLElement })
