'use strict';
/* Enlarges a picture that is clicked. */
(() => {
  const box = document.getElementById('enlarged');
  const pictures = [...document.querySelectorAll('button.picture')];
  let shown = 0;
  const show = (number) => {
    shown = (number + pictures.length) % pictures.length;
    const image = pictures[shown].querySelector('img');
    box.querySelector('img').src = image.src;
    box.querySelector('img').alt = image.alt;
    box.querySelector('p').textContent = image.alt;
  };
  pictures.forEach((picture, number) => picture.addEventListener('click', () => {
    show(number);
    box.showModal();
  }));
  box.addEventListener('click', (event) => {
    if (event.target.dataset.step) show(shown + Number(event.target.dataset.step));
    else box.close();
  });
  box.addEventListener('keydown', (event) => {
    if (event.key === 'ArrowLeft') show(shown - 1);
    if (event.key === 'ArrowRight') show(shown + 1);
  });
})();
