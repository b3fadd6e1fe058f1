import './bootstrap.scss'
import './app.css'
import { mount } from 'svelte'
import App from './App.svelte'

const target = document.getElementById('app')
if (target === null) throw new Error('The page has no element with the id app.')
target.replaceChildren()

export default mount(App, { target })
