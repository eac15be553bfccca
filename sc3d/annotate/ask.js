// What both pages of `sc3d annotate` say to the server.

const token = document.querySelector("meta[name=token]").content;

export const $ = id => document.getElementById(id);

export async function ask(path, content) {
  const headers = { "Content-Type": "application/json", "X-Token": token };
  const options = content === undefined ? {} : { method: "POST", headers, body: JSON.stringify(content) };
  const answer = await fetch(path, options).catch(() => { throw new Error("the server does not answer: is `sc3d annotate` still running?"); });
  if (!answer.ok) {
    const { error } = await answer.json().catch(() => ({}));
    throw Object.assign(new Error(error || `the server answers ${answer.status}`), { status: answer.status });
  }
  return answer.headers.get("Content-Type").startsWith("image/") ? createImageBitmap(await answer.blob()) : answer.json();
}
