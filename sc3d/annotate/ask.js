// What both pages of `sc3d annotate` say to the server.

const token = document.querySelector("meta[name=token]").content;

export const $ = id => document.getElementById(id);

export async function ask(path, content) {
  const headers = { "Content-Type": "application/json", "X-Token": token };
  const options = content === undefined ? {} : { method: "POST", headers, body: JSON.stringify(content) };
  const answer = await fetch(path, options).catch(() => { throw new Error("the server does not answer: is `sc3d annotate` still running?"); });
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).error || `the server answers ${answer.status}`);
  return answer.headers.get("Content-Type").startsWith("image/") ? createImageBitmap(await answer.blob()) : answer.json();
}
