// What a page does: filters, sorting, legends, reading values by mouse and keyboard, zoom, permalinks, following a run.
(() => {
const data = JSON.parse(document.getElementById('page-data').textContent);
const $ = (selector, root = document) => root.querySelector(selector);
const make = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith('on')) node.addEventListener(key.slice(2), value);
    else if (value !== null && value !== false) node.setAttribute(key, value === true ? '' : value);
  }
  node.append(...children.filter(child => child !== null));
  return node;
};
const rowsOf = columns => {
  const entries = Object.entries(columns).map(([key, value]) => [key, value.of ? Array.from(value.at, k => value.of[typeof k === 'string' ? k.charCodeAt(0) - 48 : k]) : value]);
  return entries.length ? entries[0][1].map((_, at) => Object.assign({_at: at}, ...entries.map(([key, values]) => ({[key]: values[at]})))) : [];
};
const save = (name, text, kind) => {
  const link = make('a', {download: name, href: URL.createObjectURL(new Blob([text], {type: kind}))});
  link.click(); setTimeout(() => URL.revokeObjectURL(link.href), 1000);
};
const csv = (keys, rows) => [keys, ...rows.map(row => keys.map(key => row[key]))].map(line => line.map(value =>
  value === null || value === undefined ? '' : /[",\n]/.test(value) ? `"${String(value).replaceAll('"', '""')}"` : value).join(',')).join('\n') + '\n';
const digits = value => typeof value !== 'number' ? String(value) : Number(value.toPrecision(5)).toString();
const word = (value, root = make('span')) => {
  if (value in data.names) root.append(make('abbr', {title: data.names[value]}, value)); else root.append(value);
  return root;
};

// The state of the page is its address: filters, switched-off series, orders of tables, the open cell.
const state = new URLSearchParams(location.hash.split('?')[1] || '');
let place = location.hash.slice(1).split('?')[0];
const changed = () => history.replaceState(null, '', `#${place}${state.size ? '?' + state : ''}`);
const set = (key, value) => { if (value) state.set(key, value); else state.delete(key); changed(); };
const many = key => (state.get(key) || '').split('|').filter(Boolean);
const shown = row => Object.keys(data.filters).every(key => {
  const wanted = many(key);
  return !wanted.length || !(key in row) || row[key] === null || wanted.includes(String(row[key]));
});

const updates = [];
const refresh = () => updates.forEach(update => update());

function filters() {
  const bar = $('.filters');
  if (!bar) return;
  for (const [key, {label, values}] of Object.entries(data.filters)) {
    const summary = make('summary'), box = make('details', {}, summary);
    const field = make('fieldset', {}, make('legend', {class: 'hidden'}, label));
    for (const value of values) {
      const check = make('input', {type: 'checkbox', value, onchange: () => {
        const on = [...field.querySelectorAll('input:checked')].map(input => input.value);
        set(key, on.length === values.length ? '' : on.join('|')); refresh();
      }});
      field.append(make('label', {}, check, ' ', word(value)));
    }
    box.append(field);
    box.addEventListener('keydown', event => { if (event.key === 'Escape') { box.open = false; summary.focus(); } });
    document.addEventListener('click', event => { if (!box.contains(event.target)) box.open = false; });
    updates.push(() => {
      const wanted = many(key);
      field.querySelectorAll('input').forEach(input => { input.checked = wanted.includes(input.value); });
      summary.textContent = `${label}: ${wanted.length ? wanted.join(', ') : 'all'}`;
      box.toggleAttribute('data-on', wanted.length > 0);
    });
    bar.append(box);
  }
  bar.append(make('button', {type: 'button', onclick: () => {
    Object.keys(data.filters).forEach(key => state.delete(key)); changed(); refresh();
  }}, 'show all'));
}

// ---- tables
const textOf = (texts, row, key) => texts[row._at]?.[key] ?? (row[key] === null || row[key] === undefined ? '–' : digits(row[key]));
function table(root, content) {
  const rows = rowsOf(content.values), keys = Object.keys(content.columns), number = new Set(content.numeric);
  const texts = rowsOf(content.text), sortKey = `sort.${content.name}`;
  const range = Object.fromEntries(content.shade.map(key => {
    const values = rows.map(row => row[key]).filter(value => typeof value === 'number');
    return [key, Math.max(0, ...values)];
  }));
  const body = make('tbody'), heads = {};
  const order = key => {
    const [was, way] = (state.get(sortKey) || '').split(',');
    set(sortKey, `${key},${was === key && way === 'ascending' ? 'descending' : 'ascending'}`); update();
  };
  keys.forEach(key => { heads[key] = make('th', {scope: 'col', class: number.has(key) ? null : 'word'},
    make('button', {type: 'button', onclick: () => order(key)}, content.columns[key])); });
  const head = make('tr', {}, ...Object.values(heads));
  if (content.repeat) head.append(make('th', {scope: 'col'}, 'again'));
  const box = make('input', {type: 'search', 'aria-label': `filter rows of: ${content.caption}`, placeholder: 'filter rows',
    oninput: () => update()});
  const count = make('span', {role: 'status'});
  let seen = [];
  const bar = make('div', {class: 'bar'}, box, count, make('button', {type: 'button',
    onclick: () => save(`${content.name}.csv`, csv(keys, seen), 'text/csv')}, 'save CSV'));
  const lines = rows.map(row => {
    const line = make('tr');
    keys.forEach((key, k) => {
      const text = textOf(texts, row, key);
      const cell = make(k ? 'td' : 'th', {class: number.has(key) ? null : text.length > (k ? 40 : 20) ? (text.length > 80 ? 'word long longer' : 'word long') : 'word', scope: k ? null : 'row'});
      if (range[key] && typeof row[key] === 'number') {
        cell.setAttribute('style', `--share:${(100 * Math.max(0, row[key]) / range[key]).toFixed(1)}%`);
      }
      line.append(number.has(key) ? (cell.append(text), cell) : word(text, cell));
    });
    if (content.repeat) line.append(make('td', {}, make('button', {type: 'button', onclick: () => repeat(row)}, 'command')));
    return line;
  });
  function update() {
    const words = box.value.toLowerCase().split(/\s+/), [key, way] = (state.get(sortKey) || '').split(',');
    seen = rows.filter(row => shown(row) && words.every(part => lines[row._at].textContent.toLowerCase().includes(part)));
    if (key in heads) {
      const empty = value => value === null || value === undefined || value === '';
      seen.sort((a, b) => {
        const x = a[key], y = b[key];
        if (empty(x) || empty(y)) return empty(x) - empty(y);
        const sign = typeof x === 'number' && typeof y === 'number' ? x - y : String(x).localeCompare(String(y));
        return way === 'descending' ? -sign : sign;
      });
    }
    Object.entries(heads).forEach(([name, th]) => {
      if (name === key) th.setAttribute('aria-sort', way); else th.removeAttribute('aria-sort');
    });
    body.replaceChildren(...seen.map(row => lines[row._at]));
    count.textContent = seen.length === rows.length ? `${rows.length} row${rows.length === 1 ? '' : 's'}` : `${seen.length} of ${rows.length} rows`;
  }
  const whole = make('table', {class: 'data'}, make('caption', {}, content.caption), make('thead', {}, head), body);
  root.append(bar, make('div', {class: 'scroll', tabindex: 0, role: 'region', 'aria-label': `table: ${content.caption}`}, whole));
  updates.push(update); update();
}

// ---- the command that repeats a row
const quoted = text => /^[\w.\/:,=+-]+$/.test(text) ? text : `'${String(text).replaceAll("'", `'\\''`)}'`;
function command(row) {
  const words = ['oed compare', '--plant', quoted(row.plant), '--noise-variance', row.noise_variance];
  if (row.method) words.push('--methods', quoted(row.method));
  if (row.estimator) words.push('--estimators', quoted(row.estimator)); else words.push(data.repeat.estimators);
  return [...words, data.repeat.rest].join(' ');
}
const dialog = $('dialog');
function open(title, ...content) {
  dialog.replaceChildren(make('button', {class: 'close', type: 'button', onclick: () => dialog.close()}, 'close'), make('h3', {}, title), ...content);
  if (!dialog.open) dialog.showModal();
}
function repeat(row, before = []) {
  const text = command(row), files = data.runs[`${row.plant}|${row.noise_variance}|${row.method}`];
  open([row.plant, `noise ${row.noise_variance}`, row.method, row.estimator].filter(Boolean).join(', '), ...before,
    make('p', {}, 'The command that repeats these runs, bit for bit with the same versions on one machine:'), make('pre', {id: 'command'}, text),
    make('button', {type: 'button', onclick: event => {
      getSelection().selectAllChildren($('#command')); document.execCommand('copy'); event.target.textContent = 'copied';
    }}, 'copy'), ...(files ? [make('p', {}, 'The runs themselves, one row per replicate: ', make('code', {}, files))] : []));
}

// ---- the answer: plants x noise levels, in shares of the optimum
function matrix() {
  const root = $('#matrix');
  if (!root || !data.matrix) return;
  const {table: answer, prefer} = data.matrix, content = data.tables[answer], rows = rowsOf(content.values), texts = rowsOf(content.text);
  const unique = key => [...new Set(rows.map(row => row[key]))], noises = unique('noise_variance');
  const choice = make('select', {id: 'matrix-input'}, ...unique('method').map(name => make('option', {}, name)));
  const asked = prefer.find(name => unique('method').includes(name));
  const table = make('table', {class: 'matrix'});
  const cell = (plant, noise) => {
    const here = rows.filter(row => row.plant === plant && row.noise_variance === noise);
    const wanted = choice.value === asked ? prefer : [choice.value];
    return wanted.map(name => here.find(row => row.method === name)).find(Boolean);
  };
  const percent = row => {  // digits follow the error, which the row's text has
    const share = 100 * row.c_efficiency, found = 100 * Number((textOf(texts, row, 'c_efficiency').split(' ± ')[1] ?? '').replace('<', '') || NaN);
    if (!(found > 0)) return [`${share.toFixed(share < 10 ? 1 : 0)} %`];
    const places = Math.min(Math.max(-Math.floor(Math.log10(found)), 0), 2);
    return [make('span', {}, `${share.toFixed(places)} %`), make('small', {}, ` ± ${found.toFixed(places)}`)];
  };
  const detail = (plant, noise) => {
    set('cell', `${plant}|${noise}`);
    const here = rows.filter(row => row.plant === plant && row.noise_variance === noise), root = make('div');
    table_plain(root, content, here, texts);
    const free = here.filter(row => !row.method.startsWith('oracle') && typeof row.rho === 'number').sort((a, b) => a.rho - b.rho)[0];
    repeat({plant, noise_variance: noise, method: cell(plant, noise)?.method}, [
      make('p', {}, free ? `Smallest error without knowing the plant: ${free.method} with ${free.best_estimator}, rho ${textOf(texts, free, 'rho')}.` : ''), root]);
  };
  const update = () => {
    const caption = make('caption', {}, 'Share of the certified optimum for the peak gain that the input ');
    caption.append(make('label', {for: 'matrix-input', class: 'hidden'}, 'input'), choice, ' carries ± standard error; noise variance across. Press a cell for its row.');
    const body = make('tbody');
    unique('plant').filter(plant => shown({plant})).forEach(plant => {
      const line = make('tr', {}, make('th', {scope: 'row'}, plant));
      noises.filter(noise_variance => shown({noise_variance})).forEach(noise => {
        const row = cell(plant, noise), share = row?.c_efficiency;
        line.append(make('td', {}, typeof share === 'number' ? make('button', {type: 'button', style: `--share:${(100 * share).toFixed(1)}%`,
          'aria-label': `${plant}, noise ${noise}: ${(100 * share).toFixed(0)} % of the optimum by ${row.method}`,
          onclick: () => detail(plant, noise)}, ...percent(row)) : '–'));
      });
      body.append(line);
    });
    table.replaceChildren(caption, make('thead', {}, make('tr', {}, make('td', {}), ...noises.filter(noise_variance => shown({noise_variance}))
      .map(noise => make('th', {scope: 'col'}, `noise ${noise}`)))), body);
  };
  choice.value = state.get('input') || asked || choice.value;
  choice.addEventListener('change', () => { set('input', choice.value === asked ? '' : choice.value); update(); choice.focus(); });
  root.append(table); updates.push(update); update();
  dialog.addEventListener('close', () => set('cell', ''));
  const [plant, noise] = (state.get('cell') || '').split('|');
  if (plant && noise) detail(plant, Number(noise));
}
function table_plain(root, content, rows, texts) {
  const keys = ['method', 'c_efficiency', 'best_estimator', 'rho', 'rho_predicted'].filter(key => key in content.columns);
  root.append(make('div', {class: 'scroll', tabindex: 0, role: 'region', 'aria-label': 'inputs'}, make('table', {class: 'data'},
    make('thead', {}, make('tr', {}, ...keys.map(key => make('th', {scope: 'col'}, content.columns[key])))),
    make('tbody', {}, ...rows.map(row => make('tr', {}, ...keys.map((key, k) =>
      word(textOf(texts, row, key), make(k ? 'td' : 'th', {scope: k ? null : 'row', class: content.numeric.includes(key) ? null : 'word'})))))))));
}

// ---- figures
const SHAPE = {circle: 'M13 3a3.4 3.4 0 1 0 .01 0', square: 'M10 3h6v6h-6z', 'triangle-up': 'M13 2l4 7h-8z', diamond: 'M13 1.5l4 4.5-4 4.5-4-4.5z',
  cross: 'M11.5 2h3v2.5h2.5v3h-2.5v2.5h-3v-2.5h-2.5v-3h2.5z', 'triangle-down': 'M13 10l4-7h-8z'};
function key(style, mark) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  svg.setAttribute('viewBox', '0 0 26 12'); svg.setAttribute('aria-hidden', 'true');
  const add = (d, attributes) => { const path = document.createElementNS(svg.namespaceURI, 'path'); path.setAttribute('d', d);
    Object.entries(attributes).forEach(([name, value]) => path.setAttribute(name, value)); svg.append(path); };
  if (['line', 'both', 'step'].includes(mark)) add('M1 6h24', {stroke: style.colour, 'stroke-width': 2, 'stroke-dasharray': style.dash.join(' ')});
  if (mark === 'bars') add('M4 3h18v6h-18z', {fill: style.colour});
  else if (mark === 'ticks') add('M13 1v10', {stroke: style.colour, 'stroke-width': 2.5});
  else if (mark !== 'line' && mark !== 'step') add(SHAPE[style.shape], {fill: style.colour});
  return svg;
}
function figure(root, content) {
  const rows = rowsOf(content.rows), offKey = `off.${content.name}`, panels = [...new Set(rows.map(row => row.panel ?? ''))];
  const box = make('div', {class: `panels${panels.length === 1 ? ' one' : ''}${content.square ? ' square' : ''}`}), views = [];
  const said = make('p', {class: 'hidden', role: 'status', 'aria-live': 'polite'});
  const visible = () => { const off = many(offKey); return rows.filter(row => shown(row) && !off.includes(row.series ?? '')); };
  if (content.series.length > 1) {
    const legend = make('div', {class: 'legend', role: 'group', 'aria-label': 'series shown'});
    content.series.forEach(({name, mark, ...style}) => {
      const button = make('button', {type: 'button', onclick: () => {
        const off = many(offKey); set(offKey, (off.includes(name) ? off.filter(x => x !== name) : [...off, name]).join('|')); refresh();
      }}, key(style, mark), word(name));
      updates.push(() => button.setAttribute('aria-pressed', String(!many(offKey).includes(name))));
      legend.append(button);
    });
    root.append(legend);
  }
  const values = make('details', {}, make('summary', {}, 'values as a table'));
  values.addEventListener('toggle', () => {
    if (values.open && values.childElementCount === 1) table(values, {...content, name: `${content.name}-values`, values: content.rows,
      text: {}, shade: [], caption: `values of: ${content.alt}`});
  });
  const bar = make('div', {class: 'bar'}, make('button', {type: 'button', onclick: async () => {
    for (const [n, view] of views.entries()) save(`${content.name}${views.length > 1 ? `-${n + 1}` : ''}.svg`, await view.toSVG(), 'image/svg+xml');
  }}, 'save SVG'));
  const zoom = (from, to) => views.forEach(view => { view.signal('from_x', from).signal('to_x', to).runAsync(); });
  if (content.zoom) {
    const [first, last] = content.zoom;
    const move = (shift, factor) => () => {
      const view = views[0]; if (!view) return;
      const a = view.signal('from_x'), b = view.signal('to_x'), half = Math.min((b - a) * factor, last - first) / 2;
      const middle = Math.min(Math.max((a + b) / 2 + shift * (b - a), first + half), last - half);
      zoom(middle - half, middle + half);
    };
    [['◀', 'earlier', move(-0.5, 1)], ['▶', 'later', move(0.5, 1)], ['+', 'zoom in', move(0, 0.5)], ['−', 'zoom out', move(0, 2)],
      ['all', 'show all', () => zoom(first, last)]].forEach(([text, label, onclick]) => bar.append(make('button', {type: 'button', 'aria-label': label, onclick}, text)));
    bar.append('or drag over the figure');
  }
  root.append(box, bar, said);
  if (content.columns) root.append(values);
  const draws = panels.map(name => {
    const plot = make('div', {class: 'plot'}), cursor = make('div', {class: 'cursor', hidden: true}), tip = make('div', {class: 'tip', hidden: true});
    const panel = make('div', {class: 'panel', role: 'group', tabindex: 0, 'aria-label': `${name ? name + ', ' : ''}figure: arrow keys read the values`},
      name ? make('h3', {}, name) : null, plot, cursor, tip);
    box.append(panel);
    let view = null, mine = [];
    const along = content.sideways ? 'y' : 'x';
    const update = async () => {
      mine = visible().filter(row => (row.panel ?? '') === name); panel.hidden = !mine.length;
      if (view) { view.data('rows', mine); await view.runAsync(); named(); }
    };
    const named = () => {
      const svg = $('svg', plot); if (!svg) return;
      // one image with one text: what is inside says nothing that the text, the cursor and the table of values do not
      ['role', 'aria-roledescription', 'aria-label'].forEach(key => svg.querySelectorAll(`[${key}]`).forEach(part => part.removeAttribute(key)));
      svg.setAttribute('role', 'img'); svg.setAttribute('aria-label', `${name ? name + '. ' : ''}${content.alt}`);
    };
    const start = async () => {
      if (view) return;
      const spec = structuredClone(content.spec);
      Object.assign(spec, {config: data.config, datasets: {...spec.datasets, rows: mine}});
      view = 'starting';
      view = (await vegaEmbed(plot, spec, {renderer: 'svg', actions: false, ast: true, tooltip: false, loader: {http: {}}})).view;
      views.push(view); named(); panel.dataset.drawn = 'yes'; read();
    };
    const places = () => [...new Set(mine.map(row => row[along]))].filter(value => value !== null).sort((a, b) => content.sideways ? 0 : a - b);
    const origin = () => { const svg = $('svg', plot).getBoundingClientRect(), outer = panel.getBoundingClientRect(), [x, y] = view.origin();
      return [svg.left - outer.left + x, svg.top - outer.top + y]; };
    const pixel = value => { const scale = view.scale(along); return scale(value) + (scale.bandwidth ? scale.bandwidth() / 2 : 0); };
    let index = -1, from = null;
    const hide = () => { cursor.hidden = tip.hidden = true; index = -1; };
    const show = at => {
      const all = places(); if (!all.length || !view?.scale) return;
      index = Math.min(Math.max(at, 0), all.length - 1);
      const here = mine.filter(row => row[along] === all[index] && row.y !== null), [ox, oy] = origin(), px = pixel(all[index]);
      const title = content.sideways ? all[index] : `${content.x.replace(/ \(.*/, '')} ${digits(all[index])}`;
      const lines = here.map(row => `${row.series ? row.series + ': ' : ''}${row.text ?? digits(content.sideways ? row.x : row.y)}${
        typeof row.low === 'number' && typeof row.high === 'number' ? ` (${digits(row.low)} to ${digits(row.high)})` : ''}`);
      tip.replaceChildren(make('strong', {}, title), ...lines.map(text => make('div', {}, text)));
      said.textContent = [name, title, ...lines].filter(Boolean).join('; ');
      tip.hidden = false;
      const width = panel.clientWidth;
      cursor.hidden = false;
      cursor.style.cssText = content.sideways ? `left:${ox}px;top:${oy + px}px;width:${view.width()}px;height:1px` : `left:${ox + px}px;top:${oy}px;width:1px;height:${view.height()}px`;
      const left = content.sideways ? ox + 20 : ox + px + 10;
      tip.style.left = `${Math.max(0, Math.min(left, width - tip.offsetWidth))}px`;
      tip.style.top = `${content.sideways ? oy + px + 8 : oy + 6}px`;
    };
    const nearest = event => {
      const all = places(), [ox, oy] = origin(), outer = panel.getBoundingClientRect();
      const px = content.sideways ? event.clientY - outer.top - oy : event.clientX - outer.left - ox;
      let best = 0;
      all.forEach((value, n) => { if (Math.abs(pixel(value) - px) < Math.abs(pixel(all[best]) - px)) best = n; });
      return best;
    };
    function read() {
      const brush = make('div', {class: 'brush', hidden: true}); panel.append(brush);
      const inside = event => event.clientX - panel.getBoundingClientRect().left - origin()[0];
      panel.addEventListener('pointermove', event => {
        show(nearest(event));
        if (from !== null) { const to = inside(event), [ox, oy] = origin(); brush.hidden = false;
          brush.style.cssText = `left:${ox + Math.min(from, to)}px;width:${Math.abs(to - from)}px;top:${oy}px;height:${view.height()}px`; }
      });
      panel.addEventListener('pointerleave', () => { if (document.activeElement !== panel) hide(); from = null; brush.hidden = true; });
      panel.addEventListener('blur', hide);
      panel.addEventListener('keydown', event => {
        const step = {ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1, Home: -1e9, End: 1e9, PageDown: 20, PageUp: -20}[event.key];
        if (step) { show(index < 0 ? (step < 0 ? 0 : Math.min(step - 1, 1e9)) : index + step); event.preventDefault(); }
        if (event.key === 'Escape') hide();
      });
      if (!content.zoom) return;
      panel.addEventListener('pointerdown', event => { if (event.pointerType !== 'touch') { from = inside(event); event.preventDefault(); panel.focus({preventScroll: true}); } });
      panel.addEventListener('pointerup', event => {
        const to = inside(event), scale = view.scale('x');
        if (from !== null && Math.abs(to - from) > 6) zoom(...[from, to].map(px => scale.invert(px)).sort((a, b) => a - b));
        from = null; brush.hidden = true;
      });
    }
    updates.push(update);
    update();
    return start;
  });
  new IntersectionObserver((entries, observer) => {
    if (entries.some(entry => entry.isIntersecting)) { observer.disconnect(); draws.forEach(draw => draw()); }
  }, {rootMargin: '400px'}).observe(root);
  addEventListener('beforeprint', () => draws.forEach(draw => draw()));
}

// ---- the whole page
$('#theme').addEventListener('click', () => {
  const dark = getComputedStyle(document.documentElement).colorScheme === 'dark';
  document.documentElement.dataset.theme = dark ? 'light' : 'dark';
});
if (innerWidth < 1100) $('nav details').open = false;
filters();
matrix();
for (const [id, content] of Object.entries(data.figures)) figure(document.getElementById(id), content);
for (const [id, content] of Object.entries(data.tables)) table(document.getElementById(id), content);
document.querySelectorAll('[data-download]').forEach(button => button.addEventListener('click', () =>
  save(button.dataset.download, data.downloads[button.dataset.download], 'text/csv')));
document.addEventListener('click', event => {
  const link = event.target.closest('a[href^="#"]');
  if (link) { event.preventDefault(); place = link.getAttribute('href').slice(1); changed(); const target = document.getElementById(place);
    target.scrollIntoView(); if (!target.hasAttribute('tabindex')) target.setAttribute('tabindex', -1); target.focus({preventScroll: true}); }
});
addEventListener('hashchange', () => location.reload());
refresh();
if (place) document.getElementById(place)?.scrollIntoView();
document.documentElement.dataset.ready = 'yes';
if (data.live) {
  let version = null;
  setInterval(async () => {
    try {
      const now = await (await fetch('state')).json();
      const bar = $('#progress');
      if (bar && now.total) { bar.max = now.total; bar.value = now.done; $('#progress-text').textContent = `${now.done} of ${now.total}`; }
      if (version !== null && now.version !== version) location.reload();
      version = now.version;
    } catch { /* the server has ended: the page stays as it is */ }
  }, 2000);
}
})();
