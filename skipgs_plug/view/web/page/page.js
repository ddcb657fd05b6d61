// The model in the viewer, and a panel with one photograph beside its render.
const element = (id) => document.getElementById(id);

const fail = (text) => {
  element('status').textContent = text;
  element('status').classList.add('failed');
  element('status').hidden = false;
};

const start = async () => {
  const [{ createViewer }, about] = await Promise.all([
    import('./viewer.js'),
    fetch('about.json').then((answer) => answer.json()),
  ]);
  document.title = about.name;
  element('name').textContent = about.name;
  element('count').textContent = `${about.gaussians.toLocaleString('en')} Gaussians`;
  foldHelpOnPhones();
  const viewer = await createViewer({
    container: element('viewer'),
    settings: about.settings,
    contentUrl: 'scene.sog',
    noanim: true,
    renderer: new URL(location.href).searchParams.has('webgl') ? 'webgl' : 'webgpu',
  });
  viewer.state.showAnnotations = false; // They mark the cameras of the photographs, and the panel goes to them.
  viewer.events.on('progress:changed', (share) => {
    element('status').textContent = `Loading the model, ${share} % …`;
  });
  const loaded = () => {
    viewer.state.cameraMode = 'orbit'; // The viewer's default is a flight through the scene.
    element('status').hidden = true;
    document.body.dataset.loaded = Math.round(performance.now());
  };
  if (viewer.state.loaded) loaded();
  else viewer.events.once('loaded:changed', loaded);
  if (about.views.length) panel(viewer, about);
};

// On a phone the viewer's list of controls would cover the model. A button still opens the list.
const foldHelpOnPhones = () => {
  try {
    if (innerWidth <= 640 && localStorage.getItem('controlsPanelOpen') === null) {
      localStorage.setItem('controlsPanelOpen', 'false');
    }
  } catch {
    // A page inside a frame may have no storage.
  }
};

const panel = (viewer, about) => {
  let chosen = 0;
  const kind = about.held_out ? 'held out' : 'trained on';
  const show = async () => {
    const asked = chosen;
    element('title').textContent = `${asked + 1} of ${about.views.length}: ${about.views[asked]}`;
    element('quality').textContent = 'Rendering …';
    try {
      const found = await fetch(`compare/${asked}.json`).then((answer) => answer.json());
      if (asked !== chosen) return; // Meanwhile the user asked for another photograph.
      for (const name of ['photograph', 'render', 'error']) element(name).src = found[name];
      element('gain').textContent = `Error ×${found.gain}`;
      element('quality').textContent = `PSNR ${found.psnr.toFixed(2)} dB, ${kind}`;
    } catch {
      element('quality').textContent = 'The server does not answer.';
    }
  };
  const step = (by) => () => {
    chosen = (chosen + by + about.views.length) % about.views.length;
    show();
  };
  const toggle = (open) => {
    element('panel').hidden = !open;
    element('open').setAttribute('aria-expanded', String(open));
    if (open) show();
  };
  element('open').textContent = about.held_out ? 'Held-out photographs' : 'Photographs';
  element('open').hidden = false;
  element('open').addEventListener('click', () => toggle(element('panel').hidden));
  element('close').addEventListener('click', () => toggle(false));
  element('previous').addEventListener('click', step(-1));
  element('next').addEventListener('click', step(1));
  element('stand').addEventListener('click', () => {
    if (viewer.state.loaded) viewer.selectAnnotation(chosen);
  });
};

start().catch((error) => fail(`This browser cannot show the model (${error.message}); it needs WebGL 2 or WebGPU.`));
