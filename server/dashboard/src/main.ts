// Puts the page into its place.
import { mount } from 'svelte';
import App from './App.svelte';
import { speakForFields } from './validity';
import './app.css';

speakForFields(document);
const target = document.getElementById('app');
if (target) mount(App, { target });
